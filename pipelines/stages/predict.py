"""predict: l = f(x; w), the boxes of the teacher, including those with low scores."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from curate.category_names import renamed
from curate.detections import Detections
from curate.detectors.base import (
    BatchDetector,
    CopiesDetector,
    DeclaresInput,
    Detector,
    NamesCategories,
)
from curate.detectors.devices import AUTO
from curate.detectors.precision import FLOAT32
from curate.errors import ConfigError, CurateError, ModelError, error_prefix
from curate.frames import Frame
from curate.geometry.projection import in_camera_view
from curate.warnings_once import warn_once
from db.models import BOX_COLUMNS
from pipelines.assembly import (
    Place,
    batch_size,
    check_detector,
    open_detector,
    runs_elsewhere,
)
from pipelines.category_names import check_detector_names
from pipelines.devices import detector_place
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import RoundContext, Settings
from pipelines.stages.labeled_copies import (
    TURNED,
    examine_labeled_copies,
    labeled_frames,
)
from pipelines.stages.reading import FrameReader
from pipelines.workspace.config import Config, DetectorSection, SegmenterSection
from pipelines.workspace.workspace import Workspace, open_dataset, sha256

Item = TypeVar("Item")

# Settings of detectors and segmenters that change no result, and the path, of which the content
# counts.
_WITHOUT_EFFECT = (
    "path",
    "augmented",
    "unseen",
    "batch_size",
    "workers",
    "timeout_s",
    "score_meaning",
    "providers",
    "cache",
    "cache_limit",
)
# Frames of the first batch of a command.
TRIAL_FRAMES = 8


@dataclass
class Predict:
    """Predicts the boxes of frames.

    Attributes:
        config: the configuration.
        teacher: checkpoint of the teacher; None for a command without one.
        place: workspace and round.
        labeled: labeled frames, on which a command shows how its headings are meant.
    """

    config: Config
    teacher: Path | None
    place: Place
    labeled: Sequence[str] = ()

    def open(self) -> None:
        """Open the data set and load the detector."""
        self.dataset = open_dataset(self.config)
        self.read = FrameReader(self._read)
        self.detector = open_detector(self.config, self.teacher, self.place)
        check_detector_names(self.config, self.detector)

    @property
    def batch_size(self) -> int:
        """How many frames the detector gets at a time."""
        return batch_size(self.config)

    @property
    def workers(self) -> int | None:
        """How many workers run the detector at the same time; a command may need the whole GPU."""
        configured = self.config.detector.workers
        if configured == "auto":
            return 1 if runs_elsewhere(self.config) or self.exclusive else None
        return configured

    @property
    def trial_size(self) -> int:
        """How many frames are tried first, to find out in seconds that a command is wrong."""
        return TRIAL_FRAMES if runs_elsewhere(self.config) else 0

    def trial(self, jobs: Sequence[FrameJob]) -> list[FrameRows | CurateError]:
        """Return the rows of the first frames; the same run has turned copies of labeled frames.

        Raises:
            CurateError: if the detector is wrong, all frames fail, or its headings do not fit the
                labels.
        """
        if not isinstance(self.detector, CopiesDetector):
            return self.batch(jobs)
        names = [job.frame for job in jobs]
        labeled = [name for name in self.labeled if name not in names]
        found = self.detector.predict_copies(
            {**dict.fromkeys(names), **dict.fromkeys(labeled, TURNED)}
        )
        rows = for_each(self._rows, found[: len(names)])
        raise_errors_of_detector(rows)
        self._check_headings(self.detector, dict(zip(labeled, found[len(names) :], strict=True)))
        return rows

    def _check_headings(
        self, detector: CopiesDetector, copies: Mapping[str, Detections | CurateError]
    ) -> None:
        """Compare the results of turned labeled frames with the labels.

        Raises:
            ModelError: if they do not fit.
        """
        found = {
            name: self.checked(each)
            for name, each in copies.items()
            if not isinstance(each, CurateError)
        }
        place = "detector.options.command, turned copies of labeled frames"
        problem, findings = examine_labeled_copies(self.config, self.dataset, detector, found)
        if problem:
            raise ModelError(f"{place}: {problem}")
        for finding in findings:
            if finding.state != "ok":
                warn_once(f"{place}: {finding.message}")

    def batch(self, jobs: Sequence[FrameJob]) -> list[FrameRows | CurateError]:
        """Return the rows of `prediction` of each frame."""
        names = [job.frame for job in jobs]
        found: Sequence[Detections | CurateError]
        if isinstance(self.detector, CopiesDetector):
            found = self.detector.predict_copies(dict.fromkeys(names))
        else:
            found = self.detect([self.read(name) for name in names])
        return for_each(self._rows, found)

    @property
    def exclusive(self) -> bool:
        """Whether the detector runs on a device that workers should not share."""
        place = detector_place(self.config)
        return place is not None and place.exclusive

    def prefetch(self, jobs: Sequence[FrameJob]) -> None:
        """Begin to read the frames of the next call."""
        self.read.announce(job.frame for job in jobs)

    def _read(self, frame_id: str) -> Frame:
        """Return a frame as the detector sees it."""
        if isinstance(self.detector, DeclaresInput) and not self.detector.needs_points:
            return self.dataset.read(frame_id, points=False)
        return visible(self.dataset.read(frame_id), self.config)

    def detect(self, frames: Sequence[Frame]) -> Sequence[Detections | CurateError]:
        """Return what the detector finds in each frame, in one call if it takes batches.

        Raises:
            ModelError: if it returns too few or too many results.
        """
        if not isinstance(self.detector, BatchDetector):
            return [self.detector.predict(frame) for frame in frames]
        found = self.detector.predict_batch(frames)
        if len(found) != len(frames):
            raise ModelError(f"the detector returned {len(found)} results for {len(frames)} frames")
        return found

    def checked(self, found: Detections) -> Detections:
        """Return the detections that count, by descending score."""
        return checked(found, self.config, self.detector)

    def _rows(self, found: Detections | CurateError) -> FrameRows:
        if isinstance(found, CurateError):
            raise found
        found = self.checked(found)
        return {"prediction": {**detection_columns(found), "iou": _or_none(found.iou)}}


def for_each(
    function: Callable[[Item], FrameRows], items: Iterable[Item]
) -> list[FrameRows | CurateError]:
    """Return the rows of each item, or the error that the function raised."""
    return [_rows_or_error(function, item) for item in items]


def _rows_or_error(function: Callable[[Item], FrameRows], item: Item) -> FrameRows | CurateError:
    try:
        return function(item)
    except CurateError as error:
        return error


def raise_errors_of_detector(rows: Sequence[FrameRows | CurateError]) -> None:
    """Raise an error of the first frames that later ones would have as well.

    Raises:
        CurateError: if the detector cannot be used as it is, or all frames fail.
    """
    errors = [each for each in rows if isinstance(each, CurateError)]
    for error in errors:
        if isinstance(error, ModelError | ConfigError) or len(errors) == len(rows):
            raise error


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
        "detector": settings_of_results(config.detector),
        "files": option_files(workspace),
        "categories": config.dataset.categories,
    }


def settings_of_results(section: DetectorSection | SegmenterSection) -> Settings:
    """Return the settings of a section that its results depend on.

    Where a model runs is not among them: results of another device or provider differ by rounding,
    and count as the same. Options of providers are, because they can lower the precision. A newer
    setting is left out while it is unset, so that results from before it stay valid.
    """
    unset = {name for name in ("rename", "provider_options") if not getattr(section, name)}
    if getattr(section, "precision", None) == FLOAT32:
        unset.add("precision")
    found = section.model_dump(mode="json", exclude={*_WITHOUT_EFFECT, *unset})
    return {**found, "device": AUTO} if "device" in found else found


def option_files(workspace: Workspace) -> dict[str, str]:
    """Return the hashes of the files in the detector's options, by their paths in the options.

    Raises:
        ConfigError: if a file on which a command depends does not exist.
    """
    config = workspace.config
    if runs_elsewhere(config):
        listed = config.detector.options.get("files", ())
        with error_prefix("detector.options.files"):
            return {name: sha256(workspace.root / name) for name in listed}
    path = config.detector.path
    if path is None:
        return {}
    files = {name: path.parent / name for name in _option_paths(config.detector.options)}
    return {name: sha256(file) for name, file in files.items() if file.exists()}


def _option_paths(options: object) -> Iterator[str]:
    """Yield the values of all keys `path`, `frame_list` and `config` in nested options."""
    if isinstance(options, Mapping):
        for key, value in options.items():
            if key in {"path", "frame_list", "config"} and isinstance(value, str):
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
    config = workspace.config
    check_detector(config, workspace.root)
    option_files(workspace)
    command = config.detector.options.get("command", "")
    ignores_students = "{" in command and "{teacher}" not in command
    if runs_elsewhere(config) and config.train.command and ignores_students:
        warn_once(
            "detector.options.command does not use {teacher}: the students of train.command would "
            "not predict in the next rounds"
        )


def function(workspace: Workspace, context: RoundContext) -> Predict:
    """Return what predict does with a frame."""
    place = Place(workspace.root, context.number)
    labeled = labeled_frames(workspace) if runs_elsewhere(workspace.config) else ()
    return Predict(workspace.config, context.teacher.path, place, labeled)
