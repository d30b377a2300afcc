"""Methods selected by one word, and their effect on a run."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.paths import ROOT
from support.pipelines_cli import Curate
from support.rounds import run_stage, run_workspace, state_of
from support.stored_rows import rows

from curate.detectors.pillars.checkpoint import load_checkpoint
from curate.errors import ConfigError, WorkspaceError
from pipelines.engine.rounds import find_teacher
from pipelines.labels.evidence import read_memory
from pipelines.registry import POLICIES
from pipelines.stages.methods import METHODS, method_named, method_of, with_method, zero_weight_of
from pipelines.workspace.config import Config, make_config
from pipelines.workspace.config_file import write_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace, sha256

NAMES = [
    "baseline", "uda", "uda-cl", "sess", "3dioumatch", "spsl", "pspsl", "learned", "threshold",
    "st3d", "hssda",
]  # fmt: skip


def run(workspace: Workspace) -> Workspace:
    """Bring everything up to date."""
    run_workspace(workspace)
    return workspace


def solved(workspace: Workspace, number: int, policy: str) -> None:
    """Bring a round up to a policy's weights."""
    for name in ("predict", "repredict", "points", "semantic", "solve"):
        run_stage(workspace, name, number, policy)


def test_the_methods_are_registered_policies() -> None:
    """Each has the name of a registered policy, and a one-line note."""
    assert list(METHODS) == NAMES
    for name, method in METHODS.items():
        assert method.policy == name
        assert name in POLICIES.classes
        assert method.note
        assert "\n" not in method.note
    assert [name for name in NAMES if METHODS[name].teacher == "ema"] == [
        "sess", "3dioumatch", "hssda",
    ]  # fmt: skip


def test_the_page_of_methods_is_complete() -> None:
    """Each method has its row, with its teacher."""
    page = (ROOT / "docs" / "methods.md").read_text()
    found = {row[1].strip(" `"): row[3].strip() for row in map(_cells, page.splitlines()) if row}
    words = {"student": "student", "ema": "average"}
    assert {name: words[method.teacher] for name, method in METHODS.items()} == {
        name: found.get(name) for name in NAMES
    }


def _cells(line: str) -> list[str]:
    return line.split("|") if line.count("|") == 6 else []


def test_a_method_is_one_word_in_the_configuration(tmp_path: Path) -> None:
    """It sets the teacher and the meaning of weight 0, unless they are set explicitly."""
    config = make_config({"dataset": {"root": tmp_path}}, "test")
    assert config.run.method == "pspsl"
    assert method_of(config, "pspsl") == METHODS["pspsl"]
    averaged = with_method(config, "sess")
    assert (averaged.run.method, method_of(averaged, "sess").teacher) == ("sess", "ema")
    assert averaged.model_copy(update={"run": config.run}) == config
    own = {"teacher": "student", "zero_weight": "ignore"}
    own_config = make_config({"dataset": {"root": tmp_path}, "train": own}, "test")
    own_config = with_method(own_config, "sess")
    found = method_of(own_config, "sess")
    assert (found.policy, found.teacher) == ("sess", "student")
    assert zero_weight_of(own_config, "sess") == "ignore"
    assert method_named("mylab.rules:Mine").teacher == method_named("uniform").teacher == "student"


def test_only_uncertain_labels_are_ignored(tmp_path: Path) -> None:
    """ST3D and HSSDA drop background; for other methods weight 0 marks it."""
    config = make_config({"dataset": {"root": tmp_path}}, "test")
    ignoring = [name for name in NAMES if zero_weight_of(config, name) == "ignore"]
    assert ignoring == ["st3d", "hssda"]


def test_the_error_for_an_unknown_method_lists_the_known_ones(
    curate: Curate, workspace: Workspace
) -> None:
    """In one line, before anything runs."""
    with pytest.raises(ConfigError, match="'sass': use one of baseline, uda, uda-cl, sess"):
        with_method(workspace.config, "sass")
    code, _, err = curate("run", "--method", "sass", "--workspace", workspace.root)
    assert code == ConfigError.exit_code
    assert err.count("\n") == 1
    assert rows(workspace, "SELECT * FROM prediction") == []


def test_the_old_key_gives_an_error_with_the_new_one(tmp_path: Path) -> None:
    """For a curate.toml of an earlier version."""
    with pytest.raises(ConfigError, match=r'write method = "spsl" in \[run\]'):
        make_config({"dataset": {"root": tmp_path}, "solve": {"policy": "spsl"}}, "curate.toml")


# These need more than the toy detector gives: a detector that estimates IoU, unseen frames.
DEMANDING = ("3dioumatch", "learned")


@pytest.mark.parametrize("name", [name for name in NAMES if name not in DEMANDING])
def test_every_method_can_be_run_by_its_name(
    curate: Curate, workspace: Workspace, name: str
) -> None:
    """`curate run --method` weights and exports under that name; curate.toml does not change."""
    code, _, err = curate("run", "--method", name, "--workspace", workspace.root)
    assert code == 0, err
    policies = rows(workspace, "SELECT DISTINCT policy FROM weight")
    assert policies == [(name,)]
    assert (workspace.root / "exports" / f"round-01-{name}.sqlite").is_file()
    assert 'method = "pspsl"' in (workspace.root / "curate.toml").read_text()


def test_a_detector_without_iou_cannot_use_3dioumatch(curate: Curate, workspace: Workspace) -> None:
    code, _, err = curate("run", "--method", "3dioumatch", "--workspace", workspace.root)
    assert code == ConfigError.exit_code
    assert "18 of 18 labels have no IoU estimate" in err


def test_a_dropped_label_is_not_exported(curate: Curate, workspace: Workspace) -> None:
    """It has no row of that policy; rows of other policies stay."""
    options = {"st3d": {"keep": 0.9, "ignore": 0.5}}
    dropping = workspace.with_settings("solve", options=options)
    solved(dropping, 1, "st3d")
    solved(dropping, 1, "uda")
    scores = {
        row[:3]: row[3]
        for row in rows(workspace, "SELECT round, frame_id, k, score FROM prediction")
    }
    weights = {
        row[:3]: row[3]
        for row in rows(workspace, "SELECT round, frame_id, k, v FROM weight WHERE policy = 'st3d'")
    }
    assert weights == {key: float(s >= 0.9) for key, s in scores.items() if s >= 0.5}
    assert 0 < len(weights) < len(scores)
    assert len(rows(workspace, "SELECT * FROM weight WHERE policy = 'uda'")) == len(scores)
    frame_id, k = next(key[1:] for key in scores if key not in weights)
    frame = rows(workspace, f"SELECT frame FROM frame WHERE id = {frame_id}")[0][0]
    code, _, err = curate("explain", frame, k, "--policy", "st3d", "-w", workspace.root)
    assert code == WorkspaceError.exit_code
    assert "the policy dropped it" in err


def test_a_policy_uses_its_previous_round(workspace: Workspace) -> None:
    """What it did not drop there; the error for a round without weights contains the round."""
    with pytest.raises(WorkspaceError, match="curate solve --policy st3d --round 1"):
        solved(workspace, 2, "st3d")
    solved(workspace, 1, "st3d")
    solved(workspace, 2, "st3d")
    memory = read_memory(workspace, 1, "st3d")
    kept = "SELECT v, score FROM weight JOIN prediction USING (round, frame_id, k) WHERE round = 1"
    assert len(memory.v) == len(rows(workspace, kept)) > 0
    assert memory.boxes.shape == (len(memory.v), 7)
    assert np.isnan(memory.iou).all()


def test_changed_weights_make_the_next_round_stale(workspace: Workspace) -> None:
    """Only for the policy that uses the previous round."""
    for policy in ("st3d", "uda"):
        solved(workspace, 1, policy)
        solved(workspace, 2, policy)
    changed = workspace.with_settings("repredict", views=2)
    solved(changed, 1, "st3d")
    assert state_of(workspace, "solve", "st3d", number=2) == "stale"
    assert state_of(workspace, "solve", "uda", number=2) == "done"


@pytest.mark.parametrize("priors", [("points",), ("semantic",), ()])
def test_each_prior_can_be_used_alone(workspace: Workspace, priors: Sequence[str]) -> None:
    """rho_det is then the value of that prior, or 1."""
    alone = run(workspace.with_settings("run", priors=priors))
    found = rows(alone, "SELECT rho_diff, rho_anno, rho_det, weight FROM weighted_labels")
    assert len(found) == 18
    for diff, anno, det, weight in found:
        assert det == pytest.approx({("points",): diff, ("semantic",): anno, (): 1.0}[priors])
        assert weight <= det


ABLATIONS = [
    ("semantic", {"mean": "product"}), ("semantic", {"mean": "arithmetic"}),
    ("solve", {"scope": "category"}), ("solve", {"scope": "frame"}), ("solve", {"quantile": 0.5}),
    ("solve", {"self_paced": False}),
]  # fmt: skip


@pytest.mark.parametrize(("section", "flag"), ABLATIONS, ids=str)
def test_every_ablation_of_the_weights_is_a_setting(
    curate: Curate, workspace: Workspace, section: str, flag: dict
) -> None:
    """It changes weights, and `explain` still recomputes them."""
    query = "SELECT frame, k, weight FROM weighted_labels ORDER BY frame, k"
    before = rows(run(workspace), query)
    document = workspace.config.model_dump(mode="json")
    document[section] |= flag
    changed = Config.model_validate(document)
    write_config(workspace.root / "curate.toml", changed)
    after = rows(run(replace(workspace, config=changed)), query)
    assert before != after
    frame, k, weight = max(after, key=lambda row: row[2])
    _, out, _ = curate("explain", frame, k, "--json", "-w", workspace.root)
    assert json.loads(out)["recomputed"] == pytest.approx(weight)


def trained(
    workspace: Workspace, tmp_path: Path, tiny: str, name: str, **train: object
) -> Workspace:
    """Return a workspace in which a tiny detector was trained for two rounds of a method."""
    document = workspace.config.model_dump(mode="json") | {"detector": {}}
    config = make_config(document | {"run": {"rounds": 2, "method": name}}, "test")
    own = initialise(tmp_path / f"{name}-{len(train)}", config, "0.25", "")
    settings = {"preset": tiny, "pretrain_steps": 5, "round_steps": 3} | train
    section = own.config.train.model_copy(update=settings)  # users cannot select the tiny preset
    config = own.config.model_copy(update={"train": section})
    # A teacher of so few steps may find nothing, so a round may have no labels.
    return run(replace(own, config=config, allow_empty=True))


def test_an_averaged_teacher_is_used_in_the_next_round(
    workspace: Workspace, tmp_path: Path, tiny: str
) -> None:
    """The same first teacher and labels; the average is registered, not the student."""
    averaged = trained(workspace, tmp_path, tiny, "sess")
    plain = trained(workspace, tmp_path, tiny, "sess", teacher="student")
    first, second = ([find_teacher(of, n)[1] for of in (averaged, plain)] for n in (1, 2))
    for name, array in load_checkpoint(first[0].path).weights.items():
        np.testing.assert_array_equal(array, load_checkpoint(first[1].path).weights[name])
    apart = [load_checkpoint(of.path).weights["answer.weight"] for of in second]
    assert np.abs(apart[0] - apart[1]).max() > 0
    path = averaged.root / "checkpoints" / "round-01-sess.safetensors"
    assert second[0].path == path
    assert second[0].sha256 == sha256(path)


def test_the_students_of_two_methods_are_separate(
    workspace: Workspace, tmp_path: Path, tiny: str
) -> None:
    """Each has its own checkpoint name; they share the first teacher, which is kept."""
    own = trained(workspace, tmp_path, tiny, "spsl")
    kept = [own.root / "checkpoints" / f"round-{n}.safetensors" for n in ("00", "01-spsl")]
    before = [sha256(path) for path in kept]
    run(replace(own, config=with_method(own.config, "sess"), allow_empty=True))
    assert [sha256(path) for path in kept] == before
    registered = rows(own, "SELECT round, policy, path FROM checkpoint WHERE round = 1 ORDER BY 2")
    assert registered == [
        (1, name, f"checkpoints/round-01-{name}.safetensors") for name in ("sess", "spsl")
    ]


def test_a_wrong_option_of_the_trainer_gives_a_one_line_error(
    workspace: Workspace, tmp_path: Path, tiny: str
) -> None:
    """It contains the option and its position."""
    with pytest.raises(ConfigError, match=r"train\.options.*'setps'") as info:
        trained(workspace, tmp_path, tiny, "baseline", options={"setps": 4})
    assert "\n" not in str(info.value)
