"""Export weighted labels as one CSV file (RFC 4180), for spreadsheets and scripts.

The columns are those of `weighted_labels`; an unknown value is an empty field. Numbers are written
with the digits that are needed to read them back exactly. The file cannot state the meaning of
weight 0: it depends on the policy, which is a column.
"""

import csv
import io
import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import ClassVar

from pydantic_core import to_json

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS, LabelRows, LabelSet
from curate.exporters.place import check_place
from curate.files.atomic import atomic_path

_HEADER = ",".join(WEIGHTED_LABEL_COLUMNS)
# Names that look the same in JSON, between quotes, and in CSV.
_PLAIN = re.compile(r"(?!.*null)[\w.+/-]+")


class CsvExporter:
    """An `Exporter` that writes the weighted labels of X_u as CSV, without ground truth."""

    name: ClassVar[str] = "csv"
    suffix: ClassVar[str] = ".csv"

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`."""
        check_place(path, _is_export)
        texts = [each.name for each in labels.columns if each.kind == "name"]
        count = 0
        with atomic_path(path) as partial, partial.open("wb") as file:
            file.write(",".join(labels.column_names).encode() + b"\n")
            for block in labels.blocks():
                file.write(_lines(block, texts))
                count += len(block.rows)
        return count


def _lines(block: LabelRows, texts: Sequence[str]) -> bytes:
    """Return the rows as CSV.

    Finding the shortest digits of each number takes most of the time; the compiled writer of JSON
    takes a fifth of that of Python's own. Rows of JSON are CSV, apart from brackets and quotes:

        [[1,"000008",0,"Car",12.5,null],[1,...    1,000008,0,Car,12.5,

    Rows with a name that CSV must quote are written by the module csv.

    Args:
        block: the rows.
        texts: the columns with names.
    """
    if not block.rows:
        return b""
    columns = [block[column] for column in texts]
    names = set(chain.from_iterable(columns)) - {None}
    if all(isinstance(name, str) and _PLAIN.fullmatch(name) for name in names):
        json = to_json(block.rows, bytes_mode="hex", inf_nan_mode="constants")
        # More quotes are of a text in a column of numbers.
        if json.count(b'"') == 2 * sum(len(each) - each.count(None) for each in columns):
            lines = json[2:-2].replace(b"],[", b"\n").replace(b'"', b"").replace(b"null", b"")
            return lines + b"\n"
    written = io.StringIO(newline="")
    csv.writer(written, lineterminator="\n").writerows(block.rows)
    return written.getvalue().encode()


def _is_export(path: Path) -> bool:
    with path.open(encoding="utf-8") as file:
        start = file.readline(len(_HEADER) + 1)
    return start.rstrip(",\n") == _HEADER
