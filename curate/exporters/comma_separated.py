"""Export weighted labels as one CSV file (RFC 4180), for spreadsheets and scripts.

The columns are those of `weighted_labels`; an unknown value is an empty field. Numbers are written
with all their digits and read back exactly. The file cannot state the meaning of weight 0: it
depends on the policy, which is a column.
"""

import csv
from pathlib import Path
from typing import ClassVar

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS, LabelSet
from curate.exporters.place import check_place
from curate.files.atomic import atomic_path

_HEADER = ",".join(WEIGHTED_LABEL_COLUMNS)


class CsvExporter:
    """An `Exporter` that writes the weighted labels of X_u as CSV, without ground truth."""

    name: ClassVar[str] = "csv"
    suffix: ClassVar[str] = ".csv"

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`."""
        check_place(path, _is_export)
        count = 0
        with atomic_path(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(labels.column_names)
            for block in labels.blocks():
                writer.writerows(zip(*block.values(), strict=True))
                count += len(block["k"])
        return count


def _is_export(path: Path) -> bool:
    with path.open(encoding="utf-8") as file:
        start = file.readline(len(_HEADER) + 1)
    return start.rstrip(",\n") == _HEADER
