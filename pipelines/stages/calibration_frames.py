"""The frames with ground truth from which a calibration is learned.

The teacher must not have been trained on them, or the probabilities would be too high. There are
three kinds, in the order in which `calibrate.source = "auto"` tries them:

    calibration   set aside with `curate init --calibration`
    labeled       frames of X_l that the user's detector has not seen, by detector.unseen
    folds         X_l, held out in folds, each with a teacher that is trained on the others

A bound on the share of wrong labels (max_wrong) needs frames that the fit has not used either, and
the very teacher of the round predicts them: all frames set aside, or half of them if the fit needs
the other half.
"""

from collections.abc import Iterable, Sequence
from typing import Literal

from curate.calibration.model import FEWEST_FRAMES
from curate.datasets.base import sequences_of
from curate.datasets.frame_names import FrameNames, match_frame_list
from curate.errors import ConfigError
from curate.exporters.base import named
from pipelines.assembly import open_policy
from pipelines.engine.rounds import is_pretrained, is_student_trained, is_trainable
from pipelines.engine.stage import RoundContext, TruthSource
from pipelines.labels.calibration import check_held_out
from pipelines.stages.fold_students import student_stage
from pipelines.workspace.folds import existing_folds, open_folds, split_folds
from pipelines.workspace.workspace import Workspace

SourceName = Literal["calibration", "labeled", "folds"]

SET_ASIDE: SourceName = "calibration"
_FOLDS_SETTING = "calibrate.folds"
_HOW_TO_SET_ASIDE = "set frames aside with `curate init --calibration`"


def check_truth(workspace: Workspace, policy: str, rounds: Iterable[int]) -> None:
    """Check that there are frames to learn from in some rounds, and further ones for max_wrong.

    Raises:
        ConfigError: if there are none that the teacher has not seen, or too few.
    """
    check_held_out(workspace, policy)
    sources = [choose_source(workspace, number) for number in rounds]
    if "folds" in sources and _is_enough(workspace, "folds"):
        split_folds(workspace, workspace.config.calibrate.folds, _FOLDS_SETTING)
    if SET_ASIDE in sources and reads_held_out(workspace, policy):
        frames = list(workspace.frames(SET_ASIDE))
        unit, units = units_of(workspace, frames)
        if len(set(units)) < 2 or len(frames) <= FEWEST_FRAMES:
            raise ConfigError(
                "solve.learned.max_wrong: one half of the frames set aside is for the fit, the "
                f"other for the bound, and {len(frames)} frames of {len(set(units))} {unit}s are "
                "too few; set more aside with `curate init --calibration`, or remove max_wrong"
            )


def choose_source(workspace: Workspace, number: int) -> SourceName:
    """Return the kind of frames to learn from in a round, by `calibrate.source`.

    Raises:
        ConfigError: if there are none, or the teacher of the round has seen them.
    """
    requested = workspace.config.calibrate.source
    obstacles = _obstacles(workspace, number)
    if requested != "auto":
        if obstacles[requested]:
            raise ConfigError(f'calibrate.source = "{requested}": {obstacles[requested]}')
        return requested
    possible = [name for name, reason in obstacles.items() if not reason]
    if possible:  # too few frames for a fit are used only if there are no others
        return next((each for each in possible if _is_enough(workspace, each)), possible[0])
    last: SourceName = "folds" if is_trainable(workspace) or number > 1 else "labeled"
    raise ConfigError(f"calibrate: {obstacles[last]}, or {_HOW_TO_SET_ASIDE}")


def truth(
    workspace: Workspace, context: RoundContext, policy: str, *, create: bool
) -> Sequence[TruthSource]:
    """Return the frames to learn from, and those for max_wrong.

    There are none if too few frames have ground truth: then nothing needs to be trained.
    """
    source, folds = choose_source(workspace, context.number), workspace.config.calibrate.folds
    if not _is_enough(workspace, source):
        return ()
    if source == "folds":
        students = tuple(student_stage(workspace, each) for each in range(1, context.number))
        opened = (
            open_folds(workspace, folds, _FOLDS_SETTING)
            if create
            else existing_folds(workspace, folds)
        )
        found = [
            TruthSource(fold, "val", f"{i}/{folds}", students) for i, fold in enumerate(opened, 1)
        ]
    else:
        found = [TruthSource(workspace, source, source)]
    if source != SET_ASIDE and reads_held_out(workspace, policy):
        found.append(TruthSource(workspace, SET_ASIDE, SET_ASIDE))
    return found


def reads_held_out(workspace: Workspace, policy: str) -> bool:
    """Return whether a policy needs labels that neither the teacher nor the fit has used."""
    return "p_value" in open_policy(workspace.config, policy).reads


def unseen_frames(workspace: Workspace) -> frozenset[str] | None:
    """Return the frames in `detector.unseen`; None if it is unset, or curate trains the teacher.

    Raises:
        ConfigError: if its file is missing, or lists a frame that is not in the data set.
    """
    unseen = workspace.config.detector.unseen
    if unseen is None or is_pretrained(workspace):
        return None
    if unseen == "labeled":
        return frozenset(workspace.frames("labeled", SET_ASIDE))
    frames = FrameNames.of_dataset(workspace.dataset)
    try:
        return frozenset(match_frame_list(unseen, frames, error_type=ConfigError))
    except ConfigError as error:
        raise ConfigError(f"detector.unseen: {error}") from None


def units_of(workspace: Workspace, frames: Sequence[str]) -> tuple[str, list[str]]:
    """Return what is exchangeable, "frame" or "sequence", and that of each frame.

    Frames of a sequence resemble each other. If the splits do not keep them together, the frame is
    the unit.
    """
    by_sequence = workspace.config.dataset.split_by == "sequence"
    sequences = sequences_of(workspace.dataset, frames) if by_sequence else {}
    return "sequence" if sequences else "frame", [sequences.get(each, each) for each in frames]


def _obstacles(workspace: Workspace, number: int) -> dict[SourceName, str]:
    """Return why each kind of frames cannot be used in a round; "" if it can."""
    return {
        SET_ASIDE: _no_calibration(workspace),
        "labeled": _no_labeled(workspace, number),
        "folds": _no_folds(workspace, number),
    }


def _is_enough(workspace: Workspace, source: SourceName) -> bool:
    """Return whether a kind has as many frames as a fit needs."""
    return len(workspace.frames("labeled" if source == "folds" else source)) >= FEWEST_FRAMES


def _no_calibration(workspace: Workspace) -> str:
    set_aside, unseen = workspace.frames(SET_ASIDE), unseen_frames(workspace)
    if not set_aside:
        return f"there are no such frames; {_HOW_TO_SET_ASIDE}"
    if unseen is not None and (seen := sorted(set(set_aside) - unseen)):
        return f"{len(seen)} frames set aside are not in detector.unseen ({named(seen)})"
    return ""


def _no_labeled(workspace: Workspace, number: int) -> str:
    if is_pretrained(workspace) or (number > 1 and is_student_trained(workspace)):
        return f"the teacher of round {number} is trained on them; use folds"
    return _not_declared(workspace)


def _no_folds(workspace: Workspace, number: int) -> str:
    if number > 1 and workspace.config.train.command is not None:
        return (
            f"the teacher of round {number} is trained by train.command, on labeled frames too, "
            "and curate cannot leave frames out of that training: train one round"
        )
    if not is_trainable(workspace):
        return f"curate cannot train detector '{workspace.config.detector.name}' for folds"
    return "" if is_pretrained(workspace) else _not_declared(workspace)


def _not_declared(workspace: Workspace) -> str:
    """Return why the labeled frames do not count as unseen by the user's detector."""
    unseen = unseen_frames(workspace)
    if unseen is None:
        return (
            f"detector '{workspace.config.detector.name}' may have been trained on the labeled "
            "frames, so they cannot be used: declare those that it has not seen (detector.unseen = "
            '"labeled", or a list of frames)'
        )
    if not unseen.intersection(workspace.frames("labeled")):
        return "detector.unseen lists no labeled frame: list some"
    return ""
