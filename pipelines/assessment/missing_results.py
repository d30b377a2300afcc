"""Frames for which recorded results have nothing, found before work starts."""

import logging

from curate.detectors.base import Detector
from curate.detectors.recorded import RecordedDetector
from pipelines.workspace.splits import HELD_OUT
from pipelines.workspace.workspace import Workspace

_log = logging.getLogger(__name__)


def report_missing_results(workspace: Workspace, detector: Detector | None) -> None:
    """Log a warning if recorded results lack frames; see `describe_missing_results`."""
    if message := describe_missing_results(workspace, detector):
        _log.warning("%s", message)


def describe_missing_results(workspace: Workspace, detector: Detector | None) -> str:
    """Return which frames besides the labeled ones have no recorded result; "" if all have one.

    Labeled frames need none.
    """
    if not isinstance(detector, RecordedDetector):
        return ""
    parts = []
    for split in ("unlabeled", *HELD_OUT):
        frames = list(workspace.frames(split))
        if missing := detector.missing_frames(frames):
            shown = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
            parts.append(f"{len(missing)} of {len(frames)} {split} frames ({shown})")
    if not parts:
        return ""
    return (
        f"{detector.path}: no results for {' and '.join(parts)}: they will fail; add the results, "
        "empty ones where the detector found nothing"
    )
