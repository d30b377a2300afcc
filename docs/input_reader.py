"""Files with variations, and what a reader does with them; see `input_cases`."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import CurateError

Content = bytes | str


@dataclass(frozen=True)
class Case:
    """A variation of a file.

    Attributes:
        variation: what is different from the plain file.
        content: of the file.
        other: whether the file holds something else than the plain file, such as no objects.
        name: of the file; "" for the reader's.
        options: with which the file is read, such as settings of the data set.
        beside: other files, by name, besides those of the reader.
    """

    variation: str
    content: Content
    other: bool = False
    name: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    beside: Sequence[tuple[str, Content]] = ()


@dataclass(frozen=True)
class Reader:
    """A reader with the variations of its file.

    Attributes:
        title: of its section on the page.
        about: sentences above the table.
        name: of the file, with its folder.
        read: reads the file; takes the options of a case as keywords.
        plain: content of a valid file.
        cases: the variations.
        beside: other files that the reader needs, by name.
    """

    title: str
    about: str
    name: str
    read: Callable[..., Any]
    plain: Content
    cases: Sequence[Case]
    beside: Sequence[tuple[str, Content]] = ()

    def outcome(self, case: Case) -> tuple[str, str]:
        """Return "read" or "rejected", and the message.

        Raises:
            AssertionError: if the file was read, but not as the plain file.
        """
        found = self._attempt(case)
        if isinstance(found, str):
            return "rejected", found
        if not case.other:
            plain = self._attempt(Case("plain", self.plain))
            if isinstance(plain, str) or plain != found:
                raise AssertionError(f"{self.title}: {case.variation}: {found}, expected {plain}")
        return "read", ""

    def _attempt(self, case: Case) -> str | list[str]:
        """Return the message without the folder, or the result as text in a list."""
        name = case.name or self.name
        with tempfile.TemporaryDirectory() as folder:
            for other, text in (*self.beside, *case.beside, (name, case.content)):
                path = Path(folder) / other
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(text if isinstance(text, bytes) else text.encode())
            try:
                return [repr(_plain(self.read(Path(folder) / name, **case.options)))]
            except CurateError as error:
                return str(error).replace(f"{folder}/", "").replace(folder, "ROOT")


def _plain(value: Any) -> Any:
    """Return arrays and objects as lists, numbers with six digits."""
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(each) for each in value]
    if hasattr(value, "__dataclass_fields__"):
        return [_plain(getattr(value, name)) for name in value.__dataclass_fields__]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def text_cases(text: str) -> list[Case]:
    """Return variations that editors and programs of other systems make of any text file."""
    return [
        Case("byte order mark", f"\ufeff{text}"),
        Case("Windows line ends", text.replace("\n", "\r\n")),
        Case("no newline at the end", text.rstrip("\n")),
        Case("empty lines at the end", f"{text}\n\n"),
        Case("blanks at the ends of lines", text.replace("\n", "  \n")),
        Case("not UTF-8", b"\xff\xfe\xfa" + text.encode()),
        Case("UTF-16", text.encode("utf-16")),
    ]
