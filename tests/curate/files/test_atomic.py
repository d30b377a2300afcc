"""Files that are written completely or not at all."""

import pytest

from curate.files.atomic import replace_file


def test_it_writes_content_and_creates_missing_folders(tmp_path):
    """Nothing else is left in the folder."""
    path = tmp_path / "deep" / "er" / "file.txt"
    replace_file(path, b"content")
    assert path.read_bytes() == b"content"
    assert list(path.parent.iterdir()) == [path]


def test_it_replaces_an_existing_file(tmp_path):
    path = tmp_path / "file.txt"
    replace_file(path, b"former")
    replace_file(path, b"later")
    assert path.read_bytes() == b"later"


def test_a_failed_write_keeps_the_earlier_file(tmp_path, monkeypatch):
    """If the rename fails, no partial file is left."""
    path = tmp_path / "file.txt"
    replace_file(path, b"former")

    def fail(self, target):
        raise OSError("no space left")

    monkeypatch.setattr("pathlib.Path.replace", fail)
    with pytest.raises(OSError, match="no space left"):
        replace_file(path, b"later")
    assert path.read_bytes() == b"former"
    assert list(tmp_path.iterdir()) == [path]
