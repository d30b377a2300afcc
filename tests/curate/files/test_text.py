"""The reader of text files."""

import pytest

from curate.errors import ConfigError, DataError
from curate.files.text import decode_text, read_lines, read_text


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", ""),
        (b"\xef\xbb\xbf", ""),
        (b"a", "a"),
        (b"\xef\xbb\xbfa\r\nb\rc\n\n", "a\nb\nc\n\n"),
        ("\ufeff\N{LATIN SMALL LETTER E WITH ACUTE}\u2028\x0b".encode(), "\xe9\u2028\x0b"),
    ],
)
def test_marks_and_line_ends_are_removed(content, text):
    """Nothing else is: other separators of Unicode do not end a line."""
    assert decode_text(content, "a") == text


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32"])
@pytest.mark.parametrize("text", ["1", "000001\n", "Car 0"])
def test_utf_16_is_rejected_by_name(encoding, text):
    """With or without a byte order mark."""
    with pytest.raises(DataError, match=r"^a: saved as UTF-16 .*; save the file as UTF-8$"):
        decode_text(text.encode(encoding), "a")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a\r\n\xe9", r"^a:2: not UTF-8 text \(byte 0xe9\); save the file as UTF-8$"),
        (b"a\rb\r\xff", r"^a:3: not UTF-8 text"),
        (b"a\nb\0", "^a:2: not a text file: a null byte$"),
        (b"\0\0\0\0", "^a:1: not a text file: a null byte$"),
        (b"\0", "^a:1: not a text file: a null byte$"),
    ],
)
def test_other_bytes_are_rejected_with_their_line(content, message):
    with pytest.raises(DataError, match=message):
        decode_text(content, "a")


def test_a_missing_file_is_reported_in_the_class_of_the_caller(tmp_path):
    with pytest.raises(ConfigError, match=r"b: no such frame list file"):
        read_lines(tmp_path / "b", "frame list", error_type=ConfigError)
    with pytest.raises(DataError, match="cannot be read: Is a directory"):
        read_text(tmp_path)
