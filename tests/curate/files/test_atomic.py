"""Tests of files that are either whole or absent."""

import pytest

from curate.files.atomic import replace_file


def test_writes_content_and_makes_missing_folders(tmp_path):
    """The file holds the content, its folder is made, and nothing else is left in it."""
    path = tmp_path / "deep" / "er" / "file.txt"
    replace_file(path, b"content")
    assert path.read_bytes() == b"content"
    assert list(path.parent.iterdir()) == [path]


def test_replaces_an_existing_file(tmp_path):
    """The later content wins."""
    path = tmp_path / "file.txt"
    replace_file(path, b"former")
    replace_file(path, b"later")
    assert path.read_bytes() == b"later"


def test_a_failed_write_keeps_the_former_file(tmp_path, monkeypatch):
    """Where the rename fails, the former file and no partial one is there."""
    path = tmp_path / "file.txt"
    replace_file(path, b"former")

    def fail(self, target):
        raise OSError("no space left")

    monkeypatch.setattr("pathlib.Path.replace", fail)
    with pytest.raises(OSError, match="no space left"):
        replace_file(path, b"later")
    assert path.read_bytes() == b"former"
    assert list(tmp_path.iterdir()) == [path]
