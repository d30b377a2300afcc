"""The policy learned in a workspace: its weights, their column everywhere, and explanations."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
from sqlalchemy import text
from support.calibrated import simulated_fit, store_calibration, store_held_out
from support.label_queries import solved
from support.labels_at_scale import filled_workspace
from support.pipelines_cli import Curate
from support.reviewed import advance
from support.silent import Silent
from support.stored_tuples import store

from curate.calibration.conformal import HeldOut, benjamini_hochberg, p_values
from curate.calibration.model import Calibration
from curate.calibration.sharpening import sharpen
from curate.errors import ConfigError, CurateError, WorkspaceError
from pipelines.engine.stage import RoundContext, RoundJob, Teacher
from pipelines.labels.label_evidence import read_label_evidence
from pipelines.registry import EXPORTERS
from pipelines.reports.explanation import Explanation, explain_label
from pipelines.stages import solve
from pipelines.stages.export import export_as
from pipelines.workspace.workspace import Workspace

REASON = "3 correct and 9 wrong labels of 2 frames, too few"


@pytest.fixture
def weighted(tmp_path: Path) -> Workspace:
    """Return a workspace with 100 labels in two frames, their evidence and weights of pspsl."""
    workspace = filled_workspace(tmp_path / "work", 2)
    config = json.dumps(workspace.config.model_dump(mode="json"))
    sizes = ", ".join(f"{name} = 1 + abs({name}) / 10" for name in ("length", "width", "height"))
    val = [("kitti", f"{i}", "val", f"{i}.bin", f"{i}.png", f"{i}.txt", None) for i in range(4)]
    with workspace.database.writing() as connection:
        connection.execute(text(f"UPDATE prediction SET {sizes}"))
        connection.execute(text("UPDATE round SET config = :config"), {"config": config})
        store(connection, "frame", val)
    return solved(workspace)


def learned(workspace: Workspace, fit: Calibration | None = None) -> Workspace:
    """Return the workspace with the weights of the policy learned."""
    store_calibration(workspace, fit or simulated_fit())
    return solved(workspace, "learned")


def rows(workspace: Workspace, query: str, **values: Any) -> list[Any]:
    with workspace.database.reading() as connection:
        return list(connection.execute(text(query), values))


def labels_of(workspace: Workspace, policy: str = "learned") -> list[Any]:
    return rows(
        workspace,
        "SELECT * FROM weighted_labels WHERE policy = :policy ORDER BY frame, k",
        policy=policy,
    )


def summary(workspace: Workspace) -> str:
    """Return the summary of solve."""
    context = RoundContext(1, 3, 0, Teacher(workspace.root, ""))
    frames = list(workspace.frames("unlabeled").values())
    return solve.run(workspace, RoundJob(context, "learned", frames), Silent()).summary


def explained(workspace: Workspace, policy: str = "learned") -> list[Explanation]:
    """Return the explanations of some labels."""
    found = labels_of(workspace, policy)[::7]
    return [explain_label(workspace, row.frame, row.k, 1, policy) for row in found]


def test_weights_follow_from_the_stored_calibration(weighted: Workspace) -> None:
    """Probabilities from the evidence in the database, then sharpened to the precision."""
    fit = simulated_fit()
    learned(weighted, fit)
    _, evidence = read_label_evidence(weighted, 1, list(weighted.frames("unlabeled").values()))
    stored = rows(
        weighted,
        "SELECT probability, v FROM weight WHERE policy = 'learned' ORDER BY frame_id, k",
    )
    p = np.array([row.probability for row in stored])
    np.testing.assert_array_equal(p, fit.probability(evidence))
    np.testing.assert_array_equal([row.v for row in stored], sharpen(p, 0.8).weights(p))
    assert len(set(p.tolist())) > 3


def test_the_evidence_is_that_of_the_view(weighted: Workspace) -> None:
    """A label outside the image, or without a match, lacks evidence."""
    with weighted.database.writing() as connection:
        connection.execute(text("UPDATE semantic_prior SET box_pixels = 0 WHERE k = 0"))
        connection.execute(text("UPDATE consistency SET loss = NULL WHERE k = 1"))
    _, evidence = read_label_evidence(weighted, 1, list(weighted.frames("unlabeled").values()))
    view = labels_of(weighted, "pspsl")
    assert evidence.score.tolist() == [row.score for row in view]
    assert evidence.points.tolist() == [row.points for row in view]
    share = [row.mask_pixels / row.box_pixels if row.box_pixels else None for row in view]
    assert [None if np.isnan(each) else each for each in evidence.pixel_share] == share
    assert np.isnan(evidence.loss).tolist() == [row.loss is None for row in view]
    assert None in share


def test_the_probability_is_the_last_column_of_the_labels(weighted: Workspace) -> None:
    """Null for a policy that estimates none; there is no column before the first estimate."""
    assert "probability" not in labels_of(weighted, "pspsl")[0]._fields
    learned(weighted)
    found = labels_of(weighted)
    assert found[0]._fields[-1] == "probability"
    assert all(0 < row.probability < 1 for row in found)
    assert {row.probability for row in labels_of(weighted, "pspsl")} == {None}


def test_exports_have_the_probability(workspace: Workspace, curate: Curate) -> None:
    """In each table of labels, as the last column."""
    advance(curate, workspace, 1)
    learned(workspace)
    expected = [row.probability for row in labels_of(workspace)]
    paths = {form: workspace.root / f"labels.{form}" for form in ("sqlite", "csv", "parquet")}
    for form, path in paths.items():
        exporter = EXPORTERS.build(form, offered={}, options={})
        export_as(workspace, exporter, 1, "learned", path)
    header, *lines = paths["csv"].read_text().splitlines()
    assert header.endswith(",probability")
    assert [float(line.rpartition(",")[2]) for line in lines] == expected
    table = pyarrow.parquet.read_table(paths["parquet"])
    assert table.column_names[-1] == "probability"
    assert table["probability"].to_pylist() == expected
    query = "SELECT probability FROM label"
    _, out, _ = curate("query", query, "--file", paths["sqlite"], "--json")
    assert [each["probability"] for each in json.loads(out)] == expected


def test_the_schema_describes_the_column(weighted: Workspace, curate: Curate) -> None:
    learned(weighted)
    _, out, _ = curate("query", "--schema", "-w", weighted.root)
    assert "that the label is correct" in out


def test_without_a_fit_the_labels_are_weighted_as_by_pspsl(weighted: Workspace) -> None:
    """Solve says so in its summary, and so does an explanation."""
    store_calibration(weighted, None, REASON)
    assert summary(weighted).count(f"weighted as by pspsl: {REASON}") == 1
    solved(weighted, "learned")
    query = "SELECT frame_id, k, v, lambda_u FROM weight WHERE policy = :policy ORDER BY 1, 2"
    found, expected = (rows(weighted, query, policy=each) for each in ("learned", "pspsl"))
    assert found == expected
    for each, other in zip(explained(weighted), explained(weighted, "pspsl"), strict=True):
        assert (each.recomputed, each.age) == (other.recomputed, other.age)
        assert f"  no calibration {REASON}; weighted as by pspsl" in each.lines
        assert "Eq. 11" in each.as_text()
        assert each.probability is None


def test_a_round_without_a_calibration_is_reported(weighted: Workspace) -> None:
    """With the command that makes one."""
    with pytest.raises(WorkspaceError, match="round 1 has no calibration; run `curate calibrate"):
        solved(weighted, "learned")


def test_a_calibration_of_other_categories_is_reported(weighted: Workspace) -> None:
    fit = simulated_fit()
    store_calibration(weighted, replace(fit, categories=("Van", *fit.categories[1:])))
    with pytest.raises(ConfigError, match="run `curate calibrate` again"):
        solved(weighted, "learned")


def test_a_damaged_calibration_is_reported(weighted: Workspace) -> None:
    store_calibration(weighted, simulated_fit())
    with weighted.database.writing() as connection:
        connection.execute(text("UPDATE calibration SET fit = '{}'"))
    with pytest.raises(CurateError, match="the stored calibration is damaged"):
        solved(weighted, "learned")


def test_a_precision_out_of_reach_is_reported(weighted: Workspace) -> None:
    """In the summary of solve."""
    store_calibration(weighted, replace(simulated_fit(), intercept=-9.0))
    assert summary(weighted).endswith(": 0.8 is out of reach")


def test_an_explanation_recomputes_probability_and_weight(weighted: Workspace) -> None:
    """From the stored evidence; the terms of the logit are bars on at most 80 columns."""
    learned(weighted)
    found = explained(weighted)
    for each in found:
        assert each.probability is not None
        assert each.probability.probability == pytest.approx(each.label["probability"])
        assert each.recomputed == pytest.approx(each.label["weight"], abs=1e-9)
        logit = each.probability.intercept + sum(each.probability.terms.values())
        assert 1 / (1 + np.exp(-logit)) == pytest.approx(each.label["probability"])
        bars = [line for line in each.lines if "|" in line]
        assert [line.split()[0] for line in bars[1:]] == [
            *each.probability.values.keys() - {"Car", "Pedestrian", "Cyclist"}, "category",
        ] or len(bars) == 10  # fmt: skip
        assert max(map(len, bars)) <= 80
        assert "they differ" not in each.as_text()
        assert "for a precision of 0.8 over" in each.as_text()
    steepest = max(found[0].probability.terms.values(), key=abs) if found[0].probability else 0
    assert any(line.count("+" if steepest > 0 else "-") > 10 for line in found[0].lines)


def test_an_explanation_shows_missing_evidence(weighted: Workspace) -> None:
    """Its term is 0."""
    with weighted.database.writing() as connection:
        connection.execute(text("UPDATE semantic_prior SET box_pixels = 0"))
    learned(weighted)
    [line] = [each for each in explained(weighted)[0].lines if each.startswith("    pixels")]
    assert line.split()[1:3] == ["missing", "+0.000"]


def test_weights_of_former_settings_are_noticed(weighted: Workspace) -> None:
    """The explanation differs from the stored weight."""
    learned(weighted)
    store_calibration(weighted, replace(simulated_fit(), intercept=-4.0))
    assert any("they differ" in each.as_text() for each in explained(weighted))


@pytest.fixture
def bounded(weighted: Workspace) -> Workspace:
    """Return a workspace with a bound on the share of wrong labels, and a calibration."""
    change = {"learned": weighted.config.solve.learned.model_copy(update={"max_wrong": 0.3})}
    bounded = weighted.with_settings("solve", **change)
    store_calibration(bounded, simulated_fit())
    config = json.dumps(bounded.config.model_dump(mode="json"))
    with bounded.database.writing() as connection:
        connection.execute(text("UPDATE round SET config = :config"), {"config": config})
    return bounded


def test_labels_are_selected_by_their_p_values(bounded: Workspace) -> None:
    """Against the wrong labels of held-out frames; an explanation shows the p-value."""
    frames = list(bounded.frames("val").values())
    _, evidence = read_label_evidence(bounded, 1, list(bounded.frames("unlabeled").values()))
    middle = float(np.median(simulated_fit().probability(evidence)))
    wrong = [(frame, k, middle, 0) for frame in frames for k in range(15)]
    others = [(frame, 15 + k, 0.99, right) for frame in frames for k, right in enumerate((1, None))]
    store_held_out(bounded, wrong + others)
    solved(bounded, "learned")
    stored = rows(
        bounded,
        "SELECT frame_id, probability, v FROM weight WHERE policy = 'learned' ORDER BY frame_id, k",
    )
    p, unit = (np.array([row[i] for row in stored]) for i in (1, 0))
    held_out = HeldOut("frame", len(frames), np.full(len(wrong), middle))
    values = p_values(held_out, p, unit)
    selected = benjamini_hochberg(values, 0.3)
    assert [row.v for row in stored] == selected.astype(float).tolist()
    assert 0 < selected.sum() < len(selected)
    found = explained(bounded)
    assert [each.recomputed for each in found] == [each.label["weight"] for each in found]
    own = [each.probability.p_value for each in found if each.probability]
    assert own == pytest.approx(values[::7].tolist())
    assert {each.label["weight"] for each in found if "is within" in each.as_text()} == {1.0}
    assert {each.label["weight"] for each in found if "is not within" in each.as_text()} == {0.0}


def test_a_bound_out_of_reach_is_reported(bounded: Workspace) -> None:
    """With the least one that selects a label."""
    [frame, *_] = bounded.frames("val").values()
    store_held_out(bounded, [(frame, k, 0.999, 0) for k in range(50)])
    assert "max_wrong 0.3 is out of reach; the least bound" in summary(bounded)


def test_a_bound_without_a_fit_does_not_hold(bounded: Workspace) -> None:
    """The labels are weighted by another policy, and the summary says what that costs."""
    store_calibration(bounded, None, REASON)
    assert f"weighted as by pspsl, and max_wrong does not hold: {REASON}" in summary(bounded)


def test_a_bound_without_held_out_frames_is_reported_before_any_work(bounded: Workspace) -> None:
    """With the option that sets frames aside."""
    with pytest.raises(ConfigError, match="curate init --calibration"):
        solve.check(bounded, "learned")
    with pytest.raises(ConfigError, match="and there are none"):
        solved(bounded, "learned")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("precision = 1.0", "solve.learned.precision = 1.0: use a number, above 0 and below 1"),
        ('max_wrong = "10 %"', 'solve.learned.max_wrong = "10 %": use a number, above 0'),
        ("precison = 0.7", "solve.learned.precison: unknown key; did you mean 'precision'?"),
    ],
)
def test_wrong_settings_are_reported_before_any_work(
    workspace: Workspace, curate: Curate, setting: str, words: str
) -> None:
    path = Path(workspace.root) / "curate.toml"
    before = path.read_text()
    kept = before.replace("precision = 0.8\n", "") if setting.startswith("precision") else before
    path.write_text(kept.replace("[solve.learned]\n", f"[solve.learned]\n{setting}\n"))
    code, _, err = curate("status", "-w", workspace.root)
    assert code == ConfigError.exit_code
    assert words in err


def test_an_explanation_for_a_policy_without_weights_says_how_to_compute_them(
    weighted: Workspace,
) -> None:
    """As after `run --method learned` in a workspace with another run.method."""
    with pytest.raises(WorkspaceError, match="no labels weighted by learned; run `curate solve"):
        explain_label(weighted, next(iter(weighted.frames("unlabeled"))), 0, 1, "learned")
