"""Exports into a folder: two at once, and the remains of a killed one."""

import json
import os
import pickle
import socket
import subprocess
import sys

import numpy as np
import pytest

from curate.exporters.folder import Streamed, write_folder, write_pickle

OTHER = """
import sys
from pathlib import Path
from curate.exporters.folder import write_folder
write_folder(Path(sys.argv[1]), "toy", lambda folder: (folder / "other").write_text("") or {})
"""


def test_two_exports_to_one_folder_do_not_mix(tmp_path):
    """Another process that finishes first loses nothing; the last one stays."""

    def fill(folder):
        (folder / "first").write_text("")
        subprocess.run([sys.executable, "-c", OTHER, tmp_path / "out"], check=True)
        assert (tmp_path / "out" / "other").exists()
        (folder / "second").write_text("")
        return {}

    write_folder(tmp_path / "out", "toy", fill)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["export.json", "first", "second"]
    assert json.loads((tmp_path / "out" / "export.json").read_text()) == {"format": "toy"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("runs", [True, False])
def test_only_the_remains_of_a_killed_export_are_removed(tmp_path, runs):
    """Those of a running process stay."""
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    process = os.getppid() if runs else ended.pid
    left = tmp_path / f".out.{socket.gethostname()}-{process}.partial"
    left.mkdir()
    write_folder(tmp_path / "out", "toy", lambda _: {})
    assert left.exists() == runs


def test_a_streamed_pickle_equals_one_of_the_whole(tmp_path):
    """Strings that occur in several items, arrays, and an object that occurs twice in one item."""
    shared = [1, "k"]
    items = [{"k": i, "twice": [shared, shared], "box": np.arange(i)} for i in range(300)]
    path = tmp_path / "a.pkl"

    def read(value):
        write_pickle(path, value)
        return pickle.loads(path.read_bytes())

    for found in (read(Streamed(iter(items))), read({"list": Streamed(items), "k": 1})["list"]):
        assert [each["k"] for each in found] == list(range(300))
        assert all(len(each["box"]) == each["k"] and each["box"].flags.writeable for each in found)
        assert found[7]["twice"] == [shared, shared]
        assert found[7]["twice"][0] is found[7]["twice"][1]
    by_name = ((str(each["k"]), each["box"]) for each in items)
    found = read(Streamed(by_name, dict))
    assert {name: len(box) for name, box in found.items()} == {str(i): i for i in range(300)}
    assert read(Streamed([])) == []
    assert read({}) == {}


def test_a_streamed_pickle_does_not_keep_its_items(tmp_path):
    """Memory does not grow with their number."""
    alive = []

    class Item:
        """Counts how many of them exist."""

        def __init__(self):
            alive.append(1)

        def __del__(self):
            alive.pop()

        def __reduce__(self):
            return str, ()

    most = 0

    def items():
        nonlocal most
        for _ in range(1000):
            yield Item()
            most = max(most, len(alive))

    write_pickle(tmp_path / "a.pkl", Streamed(items()))
    assert most < 10
