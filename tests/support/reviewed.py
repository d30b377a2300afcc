"""Reviews by the command line: export, decisions in the files, import."""

import json
from pathlib import Path

from pipelines.workspace.workspace import Workspace
from support.pipelines_cli import Curate

ADDED = "Cyclist 0 0 0 0 0 10 10 1.7 0.6 1.8 -9.0 1.0 30.0 0.1"


def advance(curate: Curate, workspace: Workspace, number: int) -> None:
    """Bring a round up to its weights."""
    for command in ("predict", "repredict", "score", "solve"):
        code, _, err = curate(command, "-w", workspace.root, "--round", number)
        assert code == 0, err


def export_review(curate: Curate, workspace: Workspace, folder: Path, *options: object) -> str:
    """Export a review; return the first of its frames."""
    code, out, err = curate("review", "export", folder, "-w", workspace.root, "--json", *options)
    assert code == 0, err
    return json.loads(out)["frames"][0]


def only_first(workspace: Workspace) -> tuple[str, str]:
    """Return the option that selects all labels of one frame and no others."""
    return "--frames", next(iter(workspace.frames("unlabeled")))


def decide(folder: Path, frame: str, k: int, word: str) -> None:
    """Write a decision into the table."""
    path = folder / "review.csv"
    start = f"{frame},{k},"
    lines = [row + word * row.startswith(start) for row in path.read_text().splitlines()]
    path.write_text("\n".join(lines) + "\n")


def corrected(folder: Path, frame: str) -> None:
    """Accept label 0, delete label 1, move label 2 half a metre ahead, add a cyclist."""
    decide(folder, frame, 0, "accept")
    path = folder / "label_2" / f"{frame}.txt"
    lines = [line.split() for line in path.read_text().splitlines()]
    lines[2][13] = f"{float(lines[2][13]) + 0.2:.4f}"
    path.write_text("\n".join([" ".join(lines[0]), " ".join(lines[2]), ADDED]) + "\n")


def import_review(curate: Curate, workspace: Workspace, folder: Path, *options: object) -> dict:
    """Import a review."""
    code, out, err = curate(
        "review", "import", folder, "-w", workspace.root, "--json", "--reviewer", "ada", *options
    )
    assert code == 0, err
    return json.loads(out)
