"""Large JSON documents, written in parts."""

import json
from pathlib import Path

import pytest

from curate.errors import DataError
from curate.exporters.json_parts import JsonParts


def test_parts_are_joined_in_their_order(tmp_path: Path) -> None:
    """Items may be added in any order; an empty part is an empty list."""
    path = tmp_path / "new" / "a.json"
    with JsonParts(path, ("one", "two", "three")) as parts:
        parts.add("two", [{"name": "NaN"}])
        parts.add("one", [1, 2.5])
        parts.add("one", [])
        parts.add("one", ["é"])
        assert (parts.next_id("one"), parts.next_id("three")) == (4, 1)
        parts.finish({"info": {}}, {"last": None})
    document = json.loads(path.read_text(encoding="utf-8"))
    assert document == {
        "info": {}, "one": [1, 2.5, "é"], "two": [{"name": "NaN"}], "three": [], "last": None,
    }  # fmt: skip
    assert list(document) == ["info", "one", "two", "three", "last"]
    assert [each.name for each in path.parent.iterdir()] == ["a.json"]


def test_parts_can_be_objects(tmp_path: Path) -> None:
    with JsonParts(tmp_path / "a.json", ("results",), "objects") as parts:
        parts.add("results", {"a": [1]})
        parts.add("results", {"b": []})
        parts.finish({"meta": 1})
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "meta": 1, "results": {"a": [1], "b": []},
    }  # fmt: skip


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_numbers_that_json_cannot_hold_are_rejected(tmp_path: Path, number: float) -> None:
    """The former document stays."""
    path = tmp_path / "a.json"
    path.write_text("{}")
    with pytest.raises(DataError, match=r"a\.json"), JsonParts(path, ("one",)) as parts:
        parts.add("one", [number])
    assert path.read_text() == "{}"
