"""The page of errors lists every class and the messages that the code raises."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from support.paths import ROOT

import curate.errors
from curate.errors import CurateError
from curate.segmenters.classes import class_map
from curate.segmenters.onnx import OnnxSegmenter
from docs.errors_page import error_classes, messages_of
from pipelines.round import round_graph
from pipelines.workspace.workspace import Workspace

PAGE = (ROOT / "docs" / "errors.md").read_text()
CLASSES = [
    value
    for value in vars(curate.errors).values()
    if isinstance(value, type) and issubclass(value, CurateError)
]


@pytest.mark.parametrize("kind", CLASSES, ids=lambda kind: kind.__name__)
def test_every_class_is_listed_with_its_exit_code(kind: type[CurateError]) -> None:
    """In the table of exit codes, and with its messages."""
    assert f"| {kind.exit_code} | `{kind.__name__}` |" in PAGE
    assert f"### {kind.__name__}\n\nExit code {kind.exit_code}:" in PAGE
    assert kind in error_classes()


@pytest.mark.parametrize(
    "fails",
    [
        lambda folder: class_map("ade"),
        lambda folder: OnnxSegmenter(folder / "none.onnx", {}),
        lambda folder: OnnxSegmenter(folder / "none.onnx", {}, tiles=0),
        lambda folder: round_graph().stage("paint"),
        Workspace.open,
    ],
)
def test_a_message_is_found_on_the_page(fails: Callable[[Path], object], tmp_path: Path) -> None:
    """A message that a user sees fits a message of the page, under its class."""
    with pytest.raises(CurateError) as caught:
        fails(tmp_path)
    kind = type(caught.value).__name__
    section = PAGE.split(f"### {kind}\n")[1].split("\n### ")[0]
    templates = re.findall(r"^\| `+ ?(.*?) ?`+ \| `[^|]*` \|$", section, re.MULTILINE)
    patterns = [re.sub(r"<[^>]*>", ".+", re.escape(one)) for one in templates]
    assert any(re.fullmatch(one, str(caught.value)) for one in patterns), caught.value


def test_messages_are_read_from_the_source(tmp_path: Path) -> None:
    """Constant texts, names of what varies, both sides of a choice, and variables."""
    (tmp_path / "curate").mkdir()
    (tmp_path / "curate" / "a.py").write_text(
        "def f(path, n):\n"
        "    if n: raise DataError(f'{path}: {n} lines' + (' or more' if n > 1 else ''))\n"
        "    hint = f'; use {\", \".join(path.names)}'\n"
        "    raise ConfigError('bad' + hint)\n"
        "    raise ValueError('not one of ours')\n"
    )
    found = messages_of(tmp_path, {"DataError", "ConfigError"})
    texts = {name: {message.text for message in messages} for name, messages in found.items()}
    assert texts == {
        "DataError": {"<path>: <n> lines or more", "<path>: <n> lines"},
        "ConfigError": {"bad; use <names>"},
    }
