"""The reader of every text file that people and other programs write.

Text is UTF-8. A byte order mark, as Windows' editors write it, and the line ends of Windows (CR LF)
and of old Macs (CR) are accepted and removed. UTF-16 ("Unicode" in Windows' editors, and what
PowerShell's `>` writes) is rejected with the remedy, by every reader alike.
"""

import codecs
from pathlib import Path

from curate.errors import CurateError, DataError

_REMEDY = "save the file as UTF-8"


def read_text(path: Path, kind: str = "text", *, error_type: type[CurateError] = DataError) -> str:
    """Return the text of a file, without byte order mark; lines end with LF.

    Args:
        path: the file.
        kind: what the file is, e.g. "label", for messages.
        error_type: class of the errors.

    Raises:
        CurateError: of class `error_type`, if the file is missing, cannot be read, or is not UTF-8.
    """
    return decode_text(read_content(path, kind, error_type=error_type), path, error_type=error_type)


def read_content(
    path: Path, kind: str = "text", *, error_type: type[CurateError] = DataError
) -> bytes:
    """Return the bytes of a file; see `read_text`."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise error_type(f"{path}: no such {kind} file") from None
    except OSError as error:
        raise error_type(f"{path}: cannot be read: {error.strerror}") from error


def read_lines(
    path: Path, kind: str = "text", *, error_type: type[CurateError] = DataError
) -> list[str]:
    """Return the lines of a file without their ends; see `read_text`."""
    return read_text(path, kind, error_type=error_type).split("\n")


def decode_text(content: bytes, place: object, *, error_type: type[CurateError] = DataError) -> str:
    """Return bytes as text, without byte order mark; lines end with LF.

    Args:
        content: the bytes.
        place: the file, for messages.
        error_type: class of the errors.

    Raises:
        CurateError: of class `error_type`, if the bytes are not UTF-8.
    """
    check_not_utf16(content[:4], place, error_type=error_type)
    content = content.removeprefix(codecs.BOM_UTF8)
    try:
        text = content.decode()
    except UnicodeDecodeError as error:
        line = _line_of(content, error.start)
        raise error_type(
            f"{place}:{line}: not UTF-8 text (byte 0x{content[error.start]:02x}); {_REMEDY}"
        ) from None
    null = content.find(b"\0")
    if null >= 0:
        raise error_type(f"{place}:{_line_of(content, null)}: not a text file: a null byte")
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


def check_not_utf16(
    start: bytes, place: object, *, error_type: type[CurateError] = DataError
) -> None:
    """Raise an error if the first four bytes of a text file are those of UTF-16 or UTF-32."""
    marks = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    halves = (start[::2], start[1::2])  # without a mark, one half of ASCII in UTF-16 is null bytes
    is_wide = len(start) > 1 and sorted(map(any, halves)) == [False, True]
    if start.startswith(marks) or (is_wide and any(map(all, halves))):
        raise error_type(f'{place}: saved as UTF-16 (Windows\' "Unicode"); {_REMEDY}')


def _line_of(content: bytes, position: int) -> int:
    before = content[:position].replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return before.count(b"\n") + 1
