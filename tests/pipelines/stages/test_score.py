"""Priors as stages: the shipped ones, and those that a user brings."""

from pathlib import Path

import pytest
from sqlalchemy import text
from support.rounds import run_workspace

from curate.errors import ConfigError
from pipelines.registry import PRIORS
from pipelines.round import round_graph
from pipelines.workspace.workspace import Workspace

OWN = "support.toys:ToyPrior"


def run(workspace: Workspace) -> dict[str, int]:
    """Runs everything; frames (or round stages) done anew, by stage."""
    return {report.stage: report.done for report in run_workspace(workspace)}


def answers(workspace: Workspace) -> list[tuple]:
    """What the view shows of the point prior and of what follows from it."""
    columns = "frame, k, points, points_threshold, rho_diff, rho_det, weight"
    with workspace.database.reading() as connection:
        query = text(f"SELECT {columns} FROM weighted_labels ORDER BY frame, k")
        return list(map(tuple, connection.execute(query)))


def test_a_prior_of_the_users_own_takes_the_place_of_another(workspace: Workspace) -> None:
    """Named as module:Class, with an option; its evidence is stored like that of the other."""
    options = {OWN: {"plenty": 5000.0}}
    own = workspace.with_settings("run", priors=(OWN, "semantic"), prior_options=options)
    assert run(own)[OWN] == 6
    rows = answers(own)
    assert len(rows) == 18
    assert {row[3] for row in rows} == {5000.0}
    assert all(row[4] == pytest.approx(row[2] / 5000) for row in rows)


def test_priors_that_take_turns_do_not_pass_for_each_other(workspace: Workspace) -> None:
    """Both fill the same table: back at the first, its evidence is gathered again."""
    run(workspace)
    before = answers(workspace)
    own = workspace.with_settings("run", priors=(OWN, "semantic"))
    done = run(own)
    assert (done[OWN], done["semantic"]) == (6, 0)
    assert answers(own) != before
    assert run(workspace)["points"] == 6
    assert answers(workspace) == before
    assert set(run(workspace).values()) == {0}


def test_other_maps_in_the_same_folder_are_looked_at_anew(
    workspace: Workspace, tmp_path: Path
) -> None:
    """A segmenter may be a folder: what is exchanged or renamed in it counts, a look at it not."""
    maps = tmp_path / "maps"
    maps.mkdir()
    (maps / "a.png").write_bytes(b"one map")
    own = workspace.with_settings("segmenter", path=maps)
    assert run(own)["semantic"] == 6
    assert run(own)["semantic"] == 0
    (maps / "a.png").write_bytes(b"another one")
    assert run(own)["semantic"] == 6
    (maps / "a.png").rename(maps / "b.png")
    assert run(own)["semantic"] == 6
    assert run(own)["semantic"] == 0


def test_two_priors_for_one_place_are_refused() -> None:
    """The error names both and the table."""
    with pytest.raises(ConfigError, match=r"points and support.toys:ToyPrior.*point_prior"):
        round_graph(("points", OWN))


def test_evidence_without_a_place_is_refused() -> None:
    """The error names what can be stored."""
    with pytest.raises(ConfigError, match=r"rho_map.*rho_diff and rho_anno"):
        round_graph(("support.toys:UnstorablePrior",))


def test_an_unknown_prior_is_refused() -> None:
    """A misspelt name is not passed over."""
    with pytest.raises(ConfigError, match="unknown prior 'pionts': use one of points, semantic"):
        round_graph(("pionts",))


def test_the_shipped_round_has_a_stage_per_registered_prior() -> None:
    """In the order of the registry, between repredict and solve."""
    graph = round_graph(tuple(PRIORS.classes))
    names = [each.name for each in graph.stages]
    assert names[names.index("repredict") + 1 : names.index("solve")] == list(PRIORS.classes)
    alone = [each.name for each in round_graph(("semantic",)).stages]
    assert alone == [name for name in names if name not in PRIORS.classes or name == "semantic"]
    assert graph.stage("points").reads == ("frame", "ground_truth", "prediction")
    assert graph.stage("semantic").reads == ("frame", "prediction")
