"""`curate next`: frames to label next from the stored evidence, and their review."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from support.pipelines_cli import Curate
from support.reviewed import import_review
from support.toys import ToySequences

from pipelines.review.next_frames import rank_frames
from pipelines.workspace.workspace import Workspace


def weigh(workspace: Workspace, weights: dict[str, float]) -> None:
    """Store a weight and score for all labels of a frame, by frame; 0 for the others."""
    keys = workspace.frames("unlabeled")
    with workspace.database.writing() as connection:
        for table, column in (("weight", "v"), ("prediction", "score")):
            change = f"UPDATE {table} SET {column} = "
            connection.exec_driver_sql(f"{change} 0")
            for frame, v in weights.items():
                connection.exec_driver_sql(f"{change} {v} WHERE frame_id = {keys[frame]}")


def test_the_most_doubtful_frames_come_first(weighted: Workspace) -> None:
    """The change of each of three labels of weight v is 2 v (1 - v)."""
    first, second, *_ = weighted.frames("unlabeled")
    weigh(weighted, {first: 0.9, second: 0.5})
    found = rank_frames(weighted, 2, frame_cost=1)
    assert [each.frame for each in found.frames] == [second, first]
    assert (found.round, found.policy, found.candidates, found.by_probability) == (
        1, "pspsl", 6, False
    )  # fmt: skip
    assert found.frames[0].change == pytest.approx(1.5)
    assert found.frames[0].boxes == pytest.approx(1.5)
    assert found.frames[0].doubtful == 3
    assert found.frames[0].reason == "doubtful: 1 Car, 1 Pedestrian, 1 Cyclist"
    assert found.frames[1].change == pytest.approx(3 * 2 * 0.9 * 0.1)


def test_a_stored_probability_replaces_the_weight(
    weighted: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Certain labels of weight 0 would change by 1; labels without p keep the weight."""
    first, *_ = weighted.frames("unlabeled")
    weigh(weighted, {})
    from pipelines.review import next_frames

    read = next_frames.read_columns

    def with_probability(*arguments: object):
        found = read(*arguments)
        of_first = found.frames == found.frame_names.index(first)
        found.numbers["probability"] = np.where(of_first, 1.0, np.nan)
        return found

    monkeypatch.setattr(next_frames, "read_columns", with_probability)
    found = rank_frames(weighted, 1)
    assert found.by_probability
    assert (found.frames[0].frame, found.frames[0].change) == (first, pytest.approx(3.0))


def test_sequences_are_spread(weighted: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three frames of a sequence, the second counts half or less."""
    monkeypatch.setattr(
        "pipelines.review.next_frames.sequences_of",
        lambda _, names: {name: ToySequences.sequence_name(name) for name in names},
    )
    names = list(weighted.frames("unlabeled"))
    weigh(weighted, dict.fromkeys(names, 0.5))
    found = rank_frames(weighted, len(names))
    assert "the first of its sequence" in found.frames[0].reason
    assert "because of others of its sequence" in found.frames[-1].reason


def test_the_command_exports_a_review(curate: Curate, weighted: Workspace, tmp_path: Path) -> None:
    """Its decisions can be imported; the frames are then left out."""
    names = list(weighted.frames("unlabeled"))
    weigh(weighted, dict.fromkeys(names, 0.5))
    folder = tmp_path / "to-label"
    options = ("--frames", 2, "-w", weighted.root)
    code, out, err = curate("next", *options, "--export", folder, "--json")
    assert code == 0, err
    found = json.loads(out)
    chosen = [each["frame"] for each in found["frames"]]
    assert sorted(path.stem for path in (folder / "pictures").iterdir()) == sorted(chosen)
    with (folder / "review.csv").open() as file:
        assert {row["frame"] for row in csv.DictReader(file)} == set(chosen)
    assert import_review(curate, weighted, folder, "--accept", "all")["accepted"] == 6
    code, out, err = curate("next", *options)
    assert code == 0, err
    assert "2 of 4 unlabeled frames" in out
    assert not any(f" {name} " in out for name in chosen)
    code, _, err = curate("next", *options, "--export", folder)
    assert code == 2
    assert "already exists and may contain edits" in err


def test_bad_input_is_reported_in_one_line(curate: Curate, weighted: Workspace) -> None:
    for options, message in (
        (("--frames", 7), "--frames 7: 6 unlabeled frames have no decision of a person yet; use"),
        (("--frames", 1, "--frame-cost", 0), "--frame-cost 0: must be above 0"),
        (("--frames", 1, "--round", 9), "round 9 has no predictions"),
        (("--frames", 1, "--policy", "hssda"), "round 1 has no labels weighted by hssda; run"),
        (("--frames", 1, "--editor", "paint"), "paint"),
    ):
        code, out, err = curate("next", "-w", weighted.root, *options)
        assert code != 0
        assert message in err
        assert err.count("\n") == 1
        assert not out


def test_without_predictions_the_error_says_what_to_run(
    curate: Curate, workspace: Workspace
) -> None:
    code, _, err = curate("next", "-w", workspace.root)
    assert code != 0
    assert err == "error: no round has predictions yet; run `curate run` or `curate predict`\n"
