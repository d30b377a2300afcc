"""The page of input formats: what each reader tolerates and what it rejects, found by reading."""

from docs.errors_page import as_code
from docs.input_cases import readers
from docs.input_reader import Reader

_INTRODUCTION = """\
What curate does with files that are not quite as described: the outcome of each row was found by
reading such a file. `read` means that the content is the same as that of the plain file, or what
the row says. A rejected file is an error in one line; where many frames are processed, the frame is
recorded as failed and the others go on. Names and numbers in the messages are examples.

The formats themselves are described on the pages [Data sets](datasets.md),
[Detectors](detectors.md), [Segmenters](segmenters.md) and [Review](review.md).
"""


def input_formats_page(note: str) -> str:
    """Return the page with a section for each reader."""
    parts = ["# Input formats", note, _INTRODUCTION]
    for reader in readers():
        parts += [f"## {reader.title}", "", reader.about, ""]
        parts += ["| variation | outcome | message |", "|---|---|---|", *rows_of(reader), ""]
    return "\n".join(parts)


def rows_of(reader: Reader) -> list[str]:
    """Return the rows of a reader's table."""
    return [
        f"| {case.variation} | {outcome} | {as_code(message) if message else ''} |"
        for case in reader.cases
        for outcome, message in [reader.outcome(case)]
    ]
