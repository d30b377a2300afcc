"""Results of augmented copies that a detector found elsewhere, checked before repredict starts."""

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from curate.datasets.copies import copy_kind
from curate.datasets.manifest import NAME, Manifest, sample_hashes, view_folder
from curate.detectors.recorded import RecordedDetector
from curate.errors import CurateError, DataError
from curate.evaluation.copy_examination import (
    CopiedFrame,
    describe_few_matches,
    describe_headings,
    examine_copies,
    examine_rotation_y,
)
from curate.frames import Calibration, RotationY
from curate.geometry.augmented_views import AugmentedViews
from curate.geometry.mounting import Mounting
from pipelines.assembly import copies_folder, open_detector
from pipelines.engine.stage import RoundContext
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace, sha256

_log = logging.getLogger(__name__)

# Frames with results that are compared with those of their copies.
_COMPARED = 64
# A camera that looks along x within this angle shows no difference between meanings of rotation_y.
_AHEAD_RAD = np.deg2rad(5)


def augmented_views(config: Config, seed: int, round_number: int) -> AugmentedViews:
    """Return the augmented copies of a round."""
    section = config.repredict
    return AugmentedViews(
        seed,
        round_number,
        section.views,
        section.flip_probability,
        section.rotation_limit_rad,
        section.scale_range,
    )


def manifest_of(
    workspace: Workspace, round_number: int, split: str, *, camera_view: bool = False
) -> Manifest:
    """Return the manifest that copies of a split for a round must have.

    Raises:
        DataError: if the first frame cannot be read.
    """
    config, dataset = workspace.config, workspace.dataset
    drawn = augmented_views(config, config.run.seed, round_number)
    frames = list(workspace.frames(split))
    return Manifest(
        split,
        drawn,
        camera_view,
        config.dataset.kind,
        sample_hashes(dataset, frames),
        copy_kind(dataset),
        _rotation_y(config, dataset.read(frames[0], points=False).calibration),
        {name: drawn.draw(name) for name in frames},
    )


def _rotation_y(config: Config, calibration: Calibration) -> RotationY:
    """Return how rotation_y of results in KITTI's form is most likely meant.

    Results of the frames themselves do not show it if the camera looks along x. The tools that
    write such files for LiDAR detectors use OpenPCDet's formula.
    """
    declared: RotationY | None = config.detector.options.get("rotation_y")
    if declared is not None or calibration.rotation_y != "calibration":
        return declared or calibration.rotation_y
    ahead = abs(Mounting.of(calibration).yaw_rad) < _AHEAD_RAD
    return "openpcdet" if ahead else "calibration"


def copies_fingerprint(folder: Path) -> str:
    """Return a hash of the manifest and the results of all views; "" for those that are missing."""
    views = sorted(folder.glob(f"{view_folder(0).name[:-1]}*/result*"))
    parts = [sha256(path) for path in (folder / NAME, *views) if path.exists()]
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()


def check_copies(workspace: Workspace, context: RoundContext, split: str) -> None:
    """Check manifest and results of `detector.augmented` before the first frame.

    Raises:
        DataError: if the copies are not those of this round, results are missing, or they do not
            belong to the copies.
    """
    folder = copies_folder(workspace.config, context.number)
    frames = list(workspace.frames(split))
    if folder is None or not frames:
        return
    expected = manifest_of(workspace, context.number, split)
    difference = Manifest.read(folder).difference(expected)
    if difference:
        command = f"curate augment FOLDER --round {context.number} --split {split}"
        raise DataError(f"{folder / NAME}: {difference}; write the copies with `{command}`")
    detector = open_detector(workspace.config, context.teacher.path, context.number)
    if not isinstance(detector, RecordedDetector):
        return
    for view, results in enumerate(detector.views_of_copies):
        missing = set(results.missing_frames(frames))
        if missing:
            shown = ", ".join(sorted(missing)[:3]) + (", ..." if len(missing) > 3 else "")
            _log.warning(
                "%s: no results for %d of %d copies (%s): these frames will fail; add the results, "
                "empty ones where the detector found nothing",
                results.path,
                len(missing),
                len(frames),
                shown,
            )
        usable = [name for name in frames if name not in missing]
        if problem := _problem(detector, expected, view, usable):
            raise DataError(f"{results.path}: {problem}")


def _problem(
    detector: RecordedDetector, manifest: Manifest, view: int, frames: Sequence[str]
) -> str:
    """Return in which way the results of a view do not belong to its copies; "" if they do."""
    chosen = frames[:: max(1, len(frames) // _COMPARED)]

    def read(meaning: RotationY | None = None) -> list[CopiedFrame]:
        found = []
        for name in chosen:
            try:
                plain = detector.predict_recorded(name)
                copy = detector.found_in_copy(name, view, meaning)
            except CurateError:
                continue  # the frame fails later, with its own error
            found.append(CopiedFrame(plain, copy, manifest.frames[name]))
        return found

    compared = read()
    problem = examine_copies(view, compared) or examine_rotation_y(view, compared, read)
    remark = describe_few_matches(view, compared) or describe_headings(view, compared)
    if remark and not problem:
        _log.warning("%s: %s", detector.views_of_copies[view].path, remark)
    return problem
