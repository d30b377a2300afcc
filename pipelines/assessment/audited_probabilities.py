"""The probabilities of audited labels, from a calibration that has not seen their ground truth.

On val frames this is the calibration of the round. On labeled frames it is a fit to the other
frames: with folds to the labels of the other folds, else to those of nine tenths of the frames or
sequences. Frames that a calibration was fitted to never judge it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from curate.calibration.features import LabelEvidence, mean_log_sizes
from curate.calibration.model import TooFewLabels, fit_calibration
from curate.detections import Annotations
from curate.evaluation.evaluated_labels import EvaluatedLabels
from pipelines.assembly import open_policy
from pipelines.assessment.audited_labels import AuditedPart
from pipelines.labels.calibration import needs_calibration, read_calibration, with_estimates
from pipelines.workspace.workspace import Workspace

_GROUPS = 10
"""Number of groups of frames, each with a fit to the others, without folds."""


def check_calibration(workspace: Workspace, round_number: int) -> None:
    """Check that the round has a calibration, even if it has too few labels for a fit.

    Raises:
        WorkspaceError: if it has none.
    """
    try:
        read_calibration(workspace, round_number)
    except TooFewLabels:
        return


def by_the_round(part: AuditedPart, policies: Sequence[str]) -> tuple[AuditedPart, str]:
    """Return the labels with the probabilities of their round's calibration.

    Args:
        part: the labels.
        policies: the audited policies; what they read besides the probability is estimated too.

    Returns:
        The labels, and a sentence on where the probabilities are from.

    Raises:
        TooFewLabels: if there were too few labels for a fit.
        WorkspaceError: if the round has no calibration.
        ConfigError: if the calibration was made with other settings.
    """
    opened = (open_policy(part.workspace.config, name) for name in policies)
    reads = {column for policy in opened if needs_calibration(policy) for column in policy.reads}
    number = part.context.number
    evidence = with_estimates(part.workspace, number, part.keys, part.evidence, sorted(reads))
    return replace(part, evidence=evidence), (
        f"Probabilities are from the calibration of round {number}, which was not fitted to these "
        "frames."
    )


def cross_fitted(
    workspace: Workspace, parts: Sequence[AuditedPart], generator: np.random.Generator
) -> tuple[list[AuditedPart], str]:
    """Return the labels with probabilities of fits to the labels of other frames.

    Args:
        workspace: the workspace of the labeled frames.
        parts: the folds, or one part, which is divided into groups of frames.
        generator: draws the groups.

    Returns:
        As `by_the_round`.

    Raises:
        TooFewLabels: if there are too few labels for a fit.
    """
    labels = EvaluatedLabels.joined([part.labels for part in parts])
    features = LabelEvidence.joined([part.features for part in parts])
    if len(parts) > 1:
        group = np.repeat(np.arange(len(parts)), [part.labels.frames for part in parts])
        others = "the other folds"
    else:
        unit = labels.resampling_unit
        units = int(unit.max(initial=-1)) + 1
        group = (generator.permutation(units) % _GROUPS)[unit]
        others = "other frames" if units == labels.frames else "other sequences"
    if len(np.unique(group)) < 2:
        raise TooFewLabels(f"there are no {others} to fit a calibration to")
    truth = workspace.ground_truth("labeled")
    names = np.array([name for part in parts for name in part.frames], dtype=str)
    probability = np.full(len(labels), np.nan)
    for each in np.unique(group):
        own = group[labels.frame_index] == each
        fitted = ~own & labels.counted
        calibration = fit_calibration(
            features.select(fitted),
            labels.correct[fitted],
            labels.frame_index[fitted],
            categories=workspace.config.dataset.categories,
            sizes=_sizes(truth, names[group != each]),
        )
        probability[own] = calibration.probability(features.select(own))
    ends = np.cumsum([len(part.labels) for part in parts])[:-1]
    return [
        replace(part, evidence=replace(part.evidence, probability=own))
        for part, own in zip(parts, np.split(probability, ends), strict=True)
    ], f"The probabilities of each label are from a fit to the labels of {others}."


def _sizes(
    truth: Mapping[str, Annotations], frames: Sequence[str]
) -> dict[str, tuple[float, float, float]]:
    """Return the mean sizes of the objects of some frames."""
    found = [truth[name] for name in frames]
    return mean_log_sizes(
        np.concatenate([each.categories for each in found]),
        np.concatenate([each.boxes for each in found]),
    )
