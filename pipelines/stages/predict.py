"""predict: l = f(x; w), the boxes of the teacher, including those with low scores."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curate.category_names import renamed
from curate.detections import Detections
from curate.detectors.base import Detector, NamesCategories
from curate.errors import ModelError
from curate.frames import Frame
from curate.geometry.projection import in_camera_view
from curate.warnings_once import warn_once
from db.models import BOX_COLUMNS
from pipelines.assembly import check_detector, open_detector
from pipelines.category_names import check_detector_names
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import RoundContext, Settings
from pipelines.workspace.config import Config, DetectorSection, SegmenterSection
from pipelines.workspace.workspace import Workspace, open_dataset, sha256


@dataclass
class Predict:
    """Predicts the boxes of a frame.

    Attributes:
        config: the configuration.
        teacher: checkpoint of the teacher.
        copies_of: see `open_detector`.
    """

    config: Config
    teacher: Path
    copies_of: int | None = None

    def open(self) -> None:
        """Open the data set and load the detector."""
        self.dataset = open_dataset(self.config)
        self.detector = open_detector(self.config, self.teacher, self.copies_of)
        check_detector_names(self.config, self.detector)

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the rows of `prediction`."""
        found = self.detect(job.frame)
        return {"prediction": {**detection_columns(found), "iou": _or_none(found.iou)}}

    def detect(self, frame_id: str) -> Detections:
        """Return the detections of a frame, by descending score."""
        frame = visible(self.dataset.read(frame_id), self.config)
        return checked(self.detector.predict(frame), self.config, self.detector)


def visible(frame: Frame, config: Config) -> Frame:
    """Return the frame for the detector: with `detector.camera_view`, only points in an image."""
    if not config.detector.camera_view or not frame.cameras:
        return frame
    inside = in_camera_view(frame)
    # np.compress is six times as fast as frame.points[inside].
    return frame.with_points(np.compress(inside, frame.points, axis=0))


def checked(found: Detections, config: Config, detector: Detector | None = None) -> Detections:
    """Return the detections with configured categories and sufficient scores, by descending score.

    Names are renamed by `detector.rename` first.

    Args:
        found: what the detector returned.
        config: the configuration.
        detector: the detector; if it knows its names, they have been compared already.

    Raises:
        ModelError: if a box is not finite or has no size, a score is not in [0, 1], or a category
            differs from a configured one only in upper and lower case.
    """
    found = renamed(found, config.detector.rename)
    scores = found.scores
    if len(scores) and not (scores.min() >= 0 and scores.max() <= 1):  # also for NaN
        raise ModelError(
            f"the detector returned scores from {scores.min():.3g} to {scores.max():.3g}; a score "
            "is a probability in [0, 1]"
        )
    configured = np.isin(found.categories, config.dataset.categories)
    if not configured.all() and not isinstance(detector, NamesCategories):
        _report_unexpected(np.unique(found.categories[~configured]).tolist(), config)
    found = found.select(configured & (found.scores >= config.detector.minimum_score))
    numbers = np.column_stack([found.boxes, found.scores])
    wrong = ~np.isfinite(numbers).all(axis=1) | (found.boxes[:, 3:6] <= 0).any(axis=1)
    if wrong.any():
        example = [round(float(number), 3) for number in numbers[wrong][0]]
        raise ModelError(
            f"the detector returned a box that is not finite or has no size: {example} "
            "(x, y, z, l, w, h, yaw, score)"
        )
    return found.select(np.argsort(-found.scores, kind="stable"))


def _report_unexpected(unexpected: Sequence[str], config: Config) -> None:
    """Warn of categories that are left out.

    Raises:
        ModelError: if one differs from a configured category only in upper and lower case.
    """
    categories = {name.lower(): name for name in config.dataset.categories}
    for name in unexpected:
        if category := categories.get(name.lower()):
            raise ModelError(
                f"the detector returns '{name}', but the data set's category is '{category}':"
                f' set detector.rename = {{"{name}" = "{category}"}}, or '
                "dataset.categories"
            )
        warn_once(
            f"the detector returns '{name}', which is not a category of the data set "
            f"({', '.join(config.dataset.categories)}): such boxes are left out; detector.rename "
            "maps names"
        )


def detection_columns(found: Detections) -> dict[str, list[Any]]:
    """Return k, category, score and box of n detections as columns of `prediction`."""
    return {
        "k": list(range(len(found))),
        "category": found.categories.tolist(),
        "score": found.scores.tolist(),
        **dict(zip(BOX_COLUMNS, found.boxes.T.tolist(), strict=True)),
    }


def as_detections(columns: Mapping[str, Sequence[Any]]) -> Detections:
    """Return columns of `prediction` as detections."""
    names = ("category", "score", *BOX_COLUMNS, "iou")
    return Detections.from_rows(list(zip(*(columns[name] for name in names), strict=True)))


def _or_none(numbers: np.ndarray) -> list[float | None]:
    """Return (n,) numbers as a list with None for NaN."""
    return [None if np.isnan(number) else number for number in numbers.tolist()]


def settings(workspace: Workspace, _context: RoundContext) -> Settings:
    """Return what predictions depend on besides the frames and the teacher."""
    config = workspace.config
    return {
        "detector": config.detector.model_dump(
            mode="json", exclude={"path", "augmented", *unset_rename(config.detector)}
        ),
        "files": option_files(config),
        "categories": config.dataset.categories,
    }


def unset_rename(section: DetectorSection | SegmenterSection) -> tuple[str, ...]:
    """Return the key of `rename` if it is unset: results from before the setting stay valid."""
    return ("rename",) if section.rename is None else ()


def option_files(config: Config) -> dict[str, str]:
    """Return the hashes of the files in the detector's options, by their paths in the options."""
    path = config.detector.path
    if path is None:
        return {}
    files = {name: path.parent / name for name in _option_paths(config.detector.options)}
    return {name: sha256(file) for name, file in files.items() if file.exists()}


def _option_paths(options: object) -> Iterator[str]:
    """Yield the values of all keys `path` and `frame_list` in nested options."""
    if isinstance(options, Mapping):
        for key, value in options.items():
            if key in {"path", "frame_list"} and isinstance(value, str):
                yield value
            yield from _option_paths(value)
    elif isinstance(options, list | tuple):
        for each in options:
            yield from _option_paths(each)


def check(workspace: Workspace) -> None:
    """Check that the detector's class can be used with its options.

    Raises:
        ConfigError: if it cannot.
    """
    check_detector(workspace.config)


def function(workspace: Workspace, context: RoundContext) -> Predict:
    """Return what predict does with a frame."""
    return Predict(workspace.config, context.teacher.path)
