"""`curate diff`: two rounds of the same labels, one of them changed by hand."""

import json
import sqlite3
from contextlib import closing

import pytest
from support.pipelines_cli import Curate

from curate.errors import WorkspaceError
from pipelines.workspace.workspace import Workspace


@pytest.fixture
def two_rounds(curate: Curate, workspace: Workspace) -> Workspace:
    """Return two rounds; the toy detector predicts the same in both."""
    for number in (1, 2):
        for command in ("predict", "repredict", "score", "solve"):
            code, _, err = curate(command, "--round", number, "-w", workspace.root)
            assert code == 0, err
    return workspace


def disturb(workspace: Workspace, *statements: str) -> None:
    """Change the stored labels."""
    with closing(sqlite3.connect(workspace.root / "curate.db")) as connection:
        connection.execute("PRAGMA foreign_keys = ON")
        for statement in statements:
            connection.execute(statement)
        connection.commit()


def test_every_kind_of_change_is_counted_and_listed(curate: Curate, two_rounds: Workspace) -> None:
    """A car that disappears, one that moves a metre, a pedestrian that loses its weight."""
    first, second, third = list(two_rounds.frames("unlabeled").values())[:3]
    k = "(SELECT k FROM prediction WHERE round = 2 AND frame_id = {} AND category = '{}')"
    car, one, walker = (
        k.format(first, "Car"),
        k.format(second, "Car"),
        k.format(third, "Pedestrian"),
    )
    disturb(
        two_rounds,
        "UPDATE weight SET v = 0.5",
        f"DELETE FROM prediction WHERE round = 2 AND frame_id = {first} AND k = {car}",
        f"UPDATE prediction SET x = x + 1.5 WHERE round = 2 AND frame_id = {second} AND k = {one}",
        f"UPDATE weight SET v = 0.75 WHERE round = 2 AND frame_id = {second} AND k = {one}",
        f"UPDATE weight SET v = 0.1 WHERE round = 2 AND frame_id = {third} AND k = {walker}",
    )
    code, out, err = curate("diff", 1, 2, "--json", "-w", two_rounds.root)
    assert (code, err) == (0, "")
    found = json.loads(out)
    rows = {row["category"]: row for row in found["categories"]}
    assert list(rows) == ["Car", "Pedestrian", "Cyclist", "all"]
    car_row = rows["Car"]
    assert (car_row["before"], car_row["after"], car_row["matched"]) == (6, 5, 5)
    assert (car_row["lost"], car_row["gained"], car_row["moved"]) == (1, 0, 1)
    assert (car_row["heavier"], car_row["lighter"]) == (1, 0)
    assert (rows["Pedestrian"]["moved"], rows["Pedestrian"]["lighter"]) == (0, 1)
    assert rows["all"]["weight_before"] == pytest.approx(9.0)
    assert rows["all"]["weight_after"] == pytest.approx(9.0 - 0.5 + 0.25 - 0.4)
    kinds = [(each["change"], each["category"]) for each in found["labels"]]
    assert kinds == [("lost", "Car"), ("weight", "Pedestrian"), ("moved", "Car")]
    backwards = json.loads(curate("diff", 2, 1, "--json", "-w", two_rounds.root)[1])
    assert backwards["categories"][0]["gained"] == 1
    assert backwards["labels"][0]["change"] == "gained"


def test_the_tables_are_printed(curate: Curate, two_rounds: Workspace) -> None:
    """Within the row limit; equal rounds list nothing."""
    disturb(two_rounds, "UPDATE weight SET v = v / 2 WHERE round = 2")
    code, out, _ = curate("diff", 1, 2, "--limit", 1, "-w", two_rounds.root)
    assert code == 0
    assert "labels with the largest changes" in out
    assert len(out.split("labels with the largest changes")[1].strip().splitlines()) == 3
    assert "largest changes" not in curate("diff", 1, 1, "-w", two_rounds.root)[1]


def test_a_round_without_weights_is_reported(curate: Curate, two_rounds: Workspace) -> None:
    """The error contains the policy and what to do."""
    code, _, err = curate("diff", 1, 2, "--policy", "spsl", "-w", two_rounds.root)
    assert code == WorkspaceError.exit_code
    assert "curate solve --round 1 --policy spsl" in err
