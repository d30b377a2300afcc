"""Single settings in a configuration file."""

import tomllib
from pathlib import Path

import pytest

from curate.errors import ConfigError
from pipelines.workspace.config_file import change_settings

CHANGES = {"command": 'python "my train.py" {labels}\n', "labels_format": "st3d"}


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("a = 1  # one\n", "a = 1  # one\n\n[train]\n{command}\n{format}\n"),
        (
            "[ train ] # how\nsteps = 1\n\n[run]\ncommand = 2\n",
            "[ train ] # how\n{format}\n{command}\nsteps = 1\n\n[run]\ncommand = 2\n",
        ),
        (
            '[run]\n[train]\ncommand = "x"  # old\n# format\nlabels_format="sqlite"',
            "[run]\n[train]\n{command}\n# format\n{format}\n",
        ),
    ],
)
def test_only_the_given_settings_change(tmp_path: Path, before: str, after: str) -> None:
    """Comments, order and the other sections stay."""
    path = tmp_path / "curate.toml"
    path.write_text(before)
    change_settings(path, "train", CHANGES)
    lines = {
        "command": 'command = "python \\"my train.py\\" {labels}\\n"',
        "format": 'labels_format = "st3d"',
    }
    assert path.read_text() == after.format(**lines)
    assert tomllib.loads(path.read_text())["train"].items() >= CHANGES.items()


def test_a_byte_order_mark_does_not_hide_the_first_line(tmp_path: Path) -> None:
    """Some editors write one; such a file can be read, so it can be changed."""
    path = tmp_path / "curate.toml"
    path.write_bytes(b"\xef\xbb\xbf[train]\nsteps = 1\n")
    change_settings(path, "train", {"labels_format": "st3d"})
    assert path.read_text() == '[train]\nlabels_format = "st3d"\nsteps = 1\n'


@pytest.mark.parametrize(
    "text",
    [
        'train = { command = "x" }\n',
        '[train]\n"command" = "x"\n',
        '[train]\ncommand = """\nx\ny"""\n',
        "[train]\noptions = [\n[1],\n]\ncommand = 'x'\n",
        '[train]\na = """\ncommand = 1\n"""\ncommand = "x"\n',
        "[train\n",
    ],
)
def test_a_file_that_cannot_be_changed_stays(tmp_path: Path, text: str) -> None:
    """The error says what to write."""
    path = tmp_path / "curate.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="cannot be changed line by line") as caught:
        change_settings(path, "train", {"command": "new"})
    assert str(caught.value).endswith('add to its section [train]: command = "new"')
    assert "\n" not in str(caught.value)
    assert path.read_text() == text
