"""The scripts of examples/, run as a reader would: in a new folder, one after the other."""

import ast
import os
import re
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from support.paths import ROOT

EXAMPLES = ROOT / "examples"


def run(script: str, folder: Path, *arguments: object) -> str:
    """Return the output of a script; `curate` is the command beside this Python."""
    home = Path(sys.executable).parent
    ended = subprocess.run(
        [sys.executable, EXAMPLES / script, *map(str, arguments)],
        cwd=folder,
        env=os.environ | {"PATH": f"{home}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a new folder in which the second example has created labels."""
    made = tmp_path_factory.mktemp("examples")
    (made / "printed.txt").write_text(run("explore_labels.py", made))
    return made


def test_results_become_weighted_labels(folder: Path) -> None:
    """Every stored result has a weight, and true boxes weigh more than false ones."""
    results = [
        line for path in (folder / "results").iterdir() for line in path.read_text().splitlines()
    ]
    printed = (folder / "printed.txt").read_text()
    found = re.search(r"(\d+) labels in work/exports/labels\.sqlite", printed)
    assert found is not None
    assert 0 < int(found[1]) < len(results)
    with closing(sqlite3.connect(folder / "work/exports/labels.sqlite")) as file:
        [(count, weight)] = file.execute("SELECT count(*), avg(weight) FROM weighted_labels")
        # Stand-in results of one object differ only by 6 m to the left.
        [(sure, doubtful)] = file.execute(
            "SELECT avg(weight) FILTER (WHERE score > 0.6), avg(weight) FILTER (WHERE score < 0.5) "
            "FROM weighted_labels"
        )
    assert count == int(found[1])
    assert 0 < weight < 1
    assert sure > 2 * doubtful


def test_labels_are_explored(folder: Path) -> None:
    """SQL and pandas count the same labels; frame ids are text."""
    printed = (folder / "printed.txt").read_text()
    counted = re.findall(r"^(?:Car|Cyclist|Pedestrian)\t(\d+)", printed, re.MULTILINE)
    found = re.search(r"(\d+) labels in", printed)
    assert found is not None
    assert sum(map(int, counted)) == int(found[1])
    assert re.search(r"^ *0000\d\d +\d+ ", printed, re.MULTILINE)
    assert run("explore_labels.py", folder, "work/exports/labels.sqlite").startswith("Car\t")


def test_a_model_learns_from_the_labels(folder: Path) -> None:
    """The weighted loss falls, and the model is saved."""
    printed = run("train_your_own.py", folder, "work/exports/labels.sqlite")
    losses = [float(loss) for loss in re.findall(r"loss ([\d.]+)", printed)]
    assert losses[-1] < 0.7 * losses[0]
    assert (folder / "my_model.pt").exists()


def test_user_results_can_be_passed_by_path(folder: Path, tmp_path: Path) -> None:
    """With frames and results as arguments nothing is simulated."""
    printed = run("curate_results.py", tmp_path, folder / "simulated", folder / "results")
    assert "labels in work/exports/labels.sqlite" in printed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["work"]


def test_the_readme_lists_every_example() -> None:
    """With the first sentence of its docstring."""
    listed = re.findall(r"^\| \[`(.*?)`\]\((.*?)\) \| (.*?) \|$", _readme(), re.MULTILINE)
    assert [name for name, _, _ in listed] == sorted(path.name for path in EXAMPLES.glob("*.py"))
    for name, link, about in listed:
        first = (ast.get_docstring(ast.parse((EXAMPLES / name).read_text())) or "").split("\n")[0]
        assert name == link
        assert about.startswith(first)


def _readme() -> str:
    return (EXAMPLES / "README.md").read_text()
