"""Weighted labels as one CSV file (RFC 4180), for spreadsheets and scripts.

The columns are those of `weighted_labels`; what is unknown is an empty field. Numbers are written
so that they come back to the last bit.
"""

import csv
import io
from pathlib import Path
from typing import ClassVar

from curate.errors import ConfigError
from curate.exporters.base import WEIGHTED_LABEL_COLUMNS, LabelSet, refuse_link
from curate.exporters.objects import refuse_bad_weights
from curate.files.atomic import replace_file

_HEADER = ",".join(WEIGHTED_LABEL_COLUMNS)


class CsvExporter:
    """An `Exporter` that writes the weighted labels of X_u as CSV; ground truth is not in it."""

    name: ClassVar[str] = "csv"
    suffix: ClassVar[str] = ".csv"

    def write(self, path: Path, labels: LabelSet) -> int:
        """See `curate.exporters.base.Exporter`."""
        _refuse_foreign(path)
        refuse_bad_weights(labels)
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(WEIGHTED_LABEL_COLUMNS)
        writer.writerows(labels.labels)
        replace_file(path, text.getvalue().encode())
        return len(labels.labels)


def _refuse_foreign(path: Path) -> None:
    """ConfigError where something would be lost that is no former export."""
    refuse_link(path)
    if not path.exists():
        return
    try:
        with path.open(encoding="utf-8") as former:
            known = former.readline(len(_HEADER) + 1).rstrip("\n") == _HEADER
    except (OSError, UnicodeDecodeError):
        known = False
    if not known:
        raise ConfigError(f"{path}: is there and is no former export; name another file")
