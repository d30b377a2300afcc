"""Results of augmented copies that a detector found elsewhere, checked before repredict starts."""

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from curate.datasets.copies import copy_kind
from curate.datasets.manifest import NAME, Manifest, sample_hashes, view_folder
from curate.errors import CurateError, DataError
from curate.evaluation.copy_examination import (
    CopiedFrame,
    examine_view,
)
from curate.frames import RotationY
from curate.geometry.augmented_views import AugmentedViews
from curate.geometry.mounting import rotation_y_of_tools
from pipelines.assembly import Place, copies_folder, open_detector
from pipelines.engine.stage import RoundContext
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace, sha256

if TYPE_CHECKING:
    from curate.detectors.recorded import RecordedDetector

_log = logging.getLogger(__name__)

_SEVERAL = ", and set detector.augmented; {split} in it names the copies of each split"
# Frames with results that are compared with those of their copies.
_COMPARED = 64


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
    declared: RotationY | None = config.detector.options.get("rotation_y")
    return Manifest(
        split,
        drawn,
        camera_view,
        config.dataset.kind,
        sample_hashes(dataset, frames),
        copy_kind(dataset),
        declared or rotation_y_of_tools(dataset.read(frames[0], points=False).calibration),
        {name: drawn.draw(name) for name in frames},
    )


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
    from curate.detectors.recorded import RecordedDetector

    folder = copies_folder(workspace.config, context.number, split)
    frames = list(workspace.frames(split))
    if folder is None or not frames:
        return
    expected = manifest_of(workspace, context.number, split)
    command = f"curate augment FOLDER --round {context.number} --split {split}"
    if not (folder / NAME).exists():
        raise DataError(
            f"{folder / NAME}: no such file; write the copies with `{command}`, or correct "
            "detector.augmented"
        )
    difference = Manifest.read(folder).difference(expected)
    if difference:
        several = "" if "{split}" in str(workspace.config.detector.augmented) else _SEVERAL
        raise DataError(
            f"{folder / NAME}: {difference}; write the copies with `{command}`{several}"
        )
    place = Place(workspace.root, context.number, copies=split)
    detector = open_detector(workspace.config, context.teacher.path, place)
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
    detector: "RecordedDetector", manifest: Manifest, view: int, frames: Sequence[str]
) -> str:
    """Return in which way the results of a view do not belong to its copies; "" if they do."""
    chosen = frames[:: max(1, len(frames) // _COMPARED)]

    def read(meaning: RotationY | None) -> list[CopiedFrame]:
        found = []
        for name in chosen:
            try:
                plain = detector.predict_recorded(name)
                copy = detector.found_in_copy(name, view, meaning)
            except CurateError:
                continue  # the frame fails later, with its own error
            found.append(CopiedFrame(plain, copy, manifest.frames[name]))
        return found

    problem, remark = examine_view(view, read)
    if remark and not problem:
        _log.warning("%s: %s", detector.views_of_copies[view].path, remark)
    return problem
