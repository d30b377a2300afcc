"""predict: l = f(x; w), the teacher's boxes with low scores too."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from curate.detections import Detections
from curate.errors import ModelError
from curate.frames import Frame
from curate.geometry.projection import in_view
from db.models import BOX_COLUMNS
from pipelines.assembly import check_detector, open_detector
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import RoundContext, Settings
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace, open_dataset, sha256

_log = logging.getLogger(__name__)


@dataclass
class Predict:
    """Finds the boxes of a frame."""

    config: Config
    teacher: Path

    def open(self) -> None:
        """Load the detector."""
        self.dataset = open_dataset(self.config)
        self.detector = open_detector(self.config, self.teacher)

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the rows of `prediction`."""
        found = self.detect(job.frame)
        return {"prediction": {**detection_columns(found), "iou": _or_none(found.iou)}}

    def detect(self, frame_id: str) -> Detections:
        """Return the boxes of a frame, by falling score."""
        frame = visible(self.dataset.read(frame_id), self.config)
        return checked(self.detector.predict(frame), self.config)


def visible(frame: Frame, config: Config) -> Frame:
    """The frame as the detector sees it: only points in the camera's view, if so configured."""
    if not config.detector.camera_view:
        return frame
    seen = in_view(frame.points, frame.calibration, frame.image_size)
    return frame.with_points(np.compress(seen, frame.points, axis=0))  # six times as fast as [seen]


def checked(found: Detections, config: Config) -> Detections:
    """Return the detections of the configured categories and scores, by falling score.

    Raises:
        ModelError: a box is not finite or has no size, or a category is written in other letters.
    """
    wanted = np.isin(found.categories, config.dataset.categories)
    if not wanted.all():
        _report_others(np.unique(found.categories[~wanted]).tolist(), config)
    found = found.select(wanted & (found.scores >= config.detector.minimum_score))
    numbers = np.column_stack([found.boxes, found.scores])
    wrong = ~np.isfinite(numbers).all(axis=1) | (found.boxes[:, 3:6] <= 0).any(axis=1)
    if wrong.any():
        shown = [round(float(number), 3) for number in numbers[wrong][0]]
        raise ModelError(
            f"the detector answered a box that is not finite or has no size: {shown} "
            "(x, y, z, l, w, h, yaw, score)"
        )
    return found.select(np.argsort(-found.scores, kind="stable"))


def _report_others(others: Sequence[str], config: Config) -> None:
    """State which categories are left out; ModelError where a name is ours in other letters."""
    ours = {name.lower(): name for name in config.dataset.categories}
    for name in others:
        if name.lower() in ours:
            raise ModelError(
                f"the detector answers '{name}', the data set's category is '{ours[name.lower()]}':"
                f' set detector.options.rename = {{"{name}" = "{ours[name.lower()]}"}}, or '
                "dataset.categories"
            )
        _warn_once(name, config.dataset.categories)


@cache
def _warn_once(name: str, ours: tuple[str, ...]) -> None:
    """Once per process and name."""
    _log.warning(
        "the detector answers '%s', none of the data set's categories (%s): such boxes are left "
        "out; detector.options.rename of a recorded detector translates names",
        name,
        ", ".join(ours),
    )


def detection_columns(found: Detections) -> dict[str, list[Any]]:
    """Return number, category, score and box of each detection as the database names them."""
    return {
        "k": list(range(len(found))),
        "category": found.categories.tolist(),
        "score": found.scores.tolist(),
        **dict(zip(BOX_COLUMNS, found.boxes.T.tolist(), strict=True)),
    }


def as_detections(columns: Mapping[str, Sequence[Any]]) -> Detections:
    """Return the detections behind the columns of `prediction`."""
    names = ("category", "score", *BOX_COLUMNS, "iou")
    return Detections.from_rows(list(zip(*(columns[name] for name in names), strict=True)))


def _or_none(numbers: np.ndarray) -> list[float | None]:
    """Return the numbers as the database stores them: null, not NaN."""
    return [None if np.isnan(number) else number for number in numbers.tolist()]


def settings(workspace: Workspace, _context: RoundContext) -> Settings:
    """What predictions depend on beside the frames and the teacher."""
    config = workspace.config
    return {
        "detector": config.detector.model_dump(mode="json", exclude={"path"}),
        "files": named_files(config),
        "categories": config.dataset.categories,
    }


def named_files(config: Config) -> dict[str, str]:
    """The hashes of the files that the detector's options name beside its own path, by name."""
    path = config.detector.path
    if path is None:
        return {}
    found = {name: path.parent / name for name in _named_paths(config.detector.options)}
    return {name: sha256(place) for name, place in found.items() if place.exists()}


def _named_paths(options: object) -> Iterator[str]:
    """Yield every text within options whose key says that it is a path."""
    if isinstance(options, Mapping):
        for key, value in options.items():
            if key in {"path", "frame_list"} and isinstance(value, str):
                yield value
            yield from _named_paths(value)
    elif isinstance(options, list | tuple):
        for each in options:
            yield from _named_paths(each)


def check(workspace: Workspace) -> None:
    """Check that the detector's class can be used with its options.

    Raises:
        ConfigError: if it cannot.
    """
    check_detector(workspace.config)


def function(workspace: Workspace, context: RoundContext) -> Predict:
    """What predict does with a frame."""
    return Predict(workspace.config, context.teacher.path)
