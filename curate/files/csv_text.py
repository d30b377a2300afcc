"""The reader of CSV files as people, spreadsheets and programs write them.

The first row names the columns, in any order and in upper or lower case. The header shows whether
commas, semicolons (spreadsheets in some languages) or tabs separate the fields. Spaces around
fields, quotes, empty rows, and empty fields at the end of a row are accepted.
"""

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from curate.errors import DataError, one_line
from curate.files.text import check_not_utf16, read_text
from curate.spelling import did_you_mean

_LONGEST = 100_000  # characters of a header; the module csv rejects longer fields
_DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs"}


@dataclass(frozen=True)
class Header:
    """The first row of a CSV file.

    Attributes:
        line: its number.
        delimiter: what separates the fields.
        names: of the columns.
    """

    line: int
    delimiter: str
    names: tuple[str, ...]

    @classmethod
    def read(cls, lines: Iterator[str]) -> "Header":
        """Return the first row that is not empty, and leave the rest of the lines."""
        numbered = enumerate(lines, start=1)
        number, text = next(((n, line) for n, line in numbered if line.strip(" \t\r\n,;")), (1, ""))
        delimiter = max(_DELIMITERS, key=text.count)
        fields = next(csv.reader([text[:_LONGEST]], delimiter=delimiter, skipinitialspace=True), [])
        names = [field.strip() for field in fields]
        while names and not names[-1]:
            names.pop()
        return cls(number, delimiter, tuple(names))

    def places(self, place: object, columns: Sequence[str]) -> tuple[int, ...]:
        """Return the index of each column in a row.

        Raises:
            DataError: if a column is missing or occurs twice.
        """
        known = [name.casefold() for name in self.names]
        missing = [name for name in columns if name.casefold() not in known]
        if missing:
            hint = did_you_mean(missing[0], filter(None, self.names))
            raise DataError(
                f"{place}:{self.line}: no column {', '.join(missing)} in the header, in which "
                f"{_DELIMITERS[self.delimiter]} separate {len(known)} columns{hint}"
            )
        twice = [name for name in columns if known.count(name.casefold()) > 1]
        if twice:
            raise DataError(f"{place}:{self.line}: column {twice[0]} occurs twice in the header")
        return tuple(known.index(name.casefold()) for name in columns)

    def rows(
        self, lines: Iterable[str], place: object, first_line: int
    ) -> Iterator[tuple[int, list[str]]]:
        """Yield line number and fields of each row that is not empty.

        Args:
            lines: the lines with their ends; read row by row.
            place: the file, for messages.
            first_line: number of the first of the lines.

        Raises:
            DataError: if a row has a wrong number of fields or cannot be parsed.
        """
        reader = csv.reader(lines, delimiter=self.delimiter, skipinitialspace=True)
        width, line = len(self.names), first_line
        try:
            for row in reader:
                line = first_line - 1 + reader.line_num
                fields = list(map(str.strip, row))
                while len(fields) > width and not fields[-1]:
                    fields.pop()
                if not any(fields):
                    continue
                if len(fields) != width:
                    raise DataError(f"{place}:{line}: {len(fields)} fields, the header has {width}")
                yield line, fields
        except csv.Error as error:
            raise DataError(f"{place}:{line}: cannot be read as CSV: {one_line(error)}") from None


def read_csv(path: Path, columns: Sequence[str]) -> Iterator[tuple[int, tuple[str, ...]]]:
    """Yield line number and the requested fields of each row of a small CSV file.

    Raises:
        DataError: if the file is missing or not UTF-8, a column is missing or occurs twice, or a
            row has a wrong number of fields.
    """
    lines = iter(io.StringIO(read_text(path, "CSV")))
    header = Header.read(lines)
    places = header.places(path, columns)
    for line, row in header.rows(lines, path, header.line + 1):
        yield line, tuple(row[place] for place in places)


def number_problem(text: str) -> str | None:
    """Return what is wrong with a field that must be a number, and what to do, or None."""
    try:
        float(text)
    except ValueError:
        hint = "; write a decimal point" if "," in text else ""
        return f"{text[:40]!r} is not a number{hint}"
    return None


def open_lines(path: Path) -> Iterator[str]:
    """Yield the lines of a large CSV file with their ends, without byte order mark.

    Raises:
        DataError: if the file is not UTF-8.
    """
    with path.open("rb") as file:
        check_not_utf16(file.read(4), path)
    with path.open(newline="", encoding="utf-8-sig") as text:
        try:
            yield from text
        except UnicodeDecodeError as error:
            raise DataError(f"{path}: not UTF-8 text: {one_line(error, 200)}") from None
