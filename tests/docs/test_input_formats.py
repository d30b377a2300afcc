"""Every row of the page Input formats is true."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from docs.generate import INPUT_FORMATS

pytest.importorskip("pyarrow", reason="the extra [parquet] is not installed")
pytest.importorskip("onnx", reason="the package onnx is not installed")

from docs.input_cases import readers
from docs.input_formats_page import rows_of
from docs.input_reader import Case, Reader

READERS = {reader.title: reader for reader in readers()}
CASES = [(title, case) for title, reader in READERS.items() for case in reader.cases]


@pytest.mark.parametrize("title", READERS)
def test_a_plain_file_is_read(title: str) -> None:
    """The variations are compared with it."""
    reader = READERS[title]
    plain = Case("plain", reader.plain)
    assert reader.outcome(plain) == ("read", "")
    assert len({case.variation for case in reader.cases}) == len(reader.cases)


@pytest.mark.parametrize(
    ("title", "case"), CASES, ids=lambda each: getattr(each, "variation", each)
)
def test_a_variation_is_read_alike_or_rejected_in_one_line(title: str, case: Case) -> None:
    """The message names the file or setting; no variation is silently read as something else."""
    reader = READERS[title]
    outcome, message = reader.outcome(case)
    assert (outcome == "read") == (message == "")
    if outcome == "rejected":
        name = case.name or reader.name
        files = [name, reader.name, *(other for other, _ in (*reader.beside, *case.beside))]
        places = [place for file in files for place in (Path(file).name, str(Path(file).parent))]
        settings = [key for key in case.options if key in message]
        assert settings or any(place in message for place in places if place != ".")
        assert len(message.splitlines()) == 1
        assert len(message) > len(Path(name).name) + 10


@pytest.mark.parametrize("title", READERS)
def test_the_page_has_the_rows_of_the_reader(title: str) -> None:
    """In its section, in the same order; `make docs` writes them."""
    page = INPUT_FORMATS.read_text()
    section = page.split(f"\n## {title}\n")[1].split("\n## ")[0]
    rows = [line for line in section.splitlines() if re.match(r"\| (?!variation)", line)]
    assert rows == rows_of(READERS[title]), "run `make docs`"


def test_a_file_that_is_read_as_something_else_is_found() -> None:
    """The walk itself fails for a reader that misreads a variation."""
    wrong: Reader = replace(READERS["Lists of frames"], read=lambda path: path.read_bytes())
    with pytest.raises(AssertionError, match="Lists of frames: byte order mark"):
        wrong.outcome(wrong.cases[0])
