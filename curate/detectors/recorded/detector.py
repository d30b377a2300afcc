"""Detector that returns stored predictions."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from curate.datasets.frame_names import FrameNames, last_part
from curate.datasets.kitti.labels import KittiObjects, to_detections
from curate.datasets.manifest import Manifest, results_of
from curate.detections import Detections, as_categories
from curate.detectors.recorded.argoverse2 import check_frame_name
from curate.detectors.recorded.formats import check_kind, detect_kind
from curate.detectors.recorded.parquet import ParquetRecord
from curate.detectors.recorded.passes import PassesRecord
from curate.detectors.recorded.results import (
    ForeignBoxes,
    ReadOptions,
    RecordedResult,
    as_detections,
)
from curate.detectors.recorded.table import TableRecord
from curate.detectors.scores import describe_invalid_scores, to_probabilities
from curate.errors import ConfigError, DataError, error_prefix
from curate.files.paths import StrPath
from curate.frames import Calibration, Frame, RotationY
from curate.geometry.augmented_views import augmented_calibration
from curate.geometry.mounting import check_rotation_y
from curate.geometry.similarity import Similarity
from curate.ranges import Share
from curate.warnings_once import warn_once

# Formats that store the augmented copies in the same file.
_TABLES: Mapping[str, Callable[[Path, bool], "Record"]] = {
    "csv": lambda path, sigmoid: TableRecord.read(path, sigmoid=sigmoid),
    "parquet": lambda path, _: ParquetRecord.read(path),
}

Axes = Literal["forward-left", "right-forward"]
# Transforms from these axes to the LiDAR frame of this project (x forward, y left).
_AXES = {
    "forward-left": Similarity(),
    "right-forward": Similarity(rotation_rad=-np.pi / 2),
}


class Record(Protocol):
    """Stored results of frames and of their augmented copies."""

    @property
    def has_views(self) -> bool:
        """Whether the record contains augmented copies."""
        ...

    def frame_ids(self) -> Iterable[str]:
        """Return the recorded frames, in sorted order."""
        ...

    def category_names(self) -> Collection[str]:
        """Return the category names of all boxes."""
        ...

    def check(self, frame_ids: Iterable[str]) -> None:
        """Check the results of some frames before any work, as far as the format allows.

        Raises:
            DataError: if a result is malformed.
        """
        ...

    def result(self, frame_id: str) -> RecordedResult:
        """Return the result of the original frame.

        Raises:
            DataError: if the frame was not recorded.
        """
        ...

    def views(self, frame_id: str) -> Sequence[tuple[Similarity, RecordedResult]]:
        """Return A and the result of each augmented copy A(x), in A's frame of reference."""
        ...


class RecordedDetector:
    """A `Detector` and `RecordedViews` that returns stored predictions.

    Args:
        path: a CSV or Parquet file, a folder of KITTI result files, OpenPCDet's result.pkl,
            mmdetection3d's results (pickle of arrays, JSON, or folder of JSON), nuScenes' results
            (JSON), Argoverse 2's results (Feather), or ST3D's pseudo-labels (pickle).
        minimum_score: boxes with a lower score are left out.
        kind: the format: csv, parquet, kitti, openpcdet, mmdetection3d, nuscenes, argoverse2, st3d,
            or auto to detect it from suffix and contents.
        passes: the passes over augmented copies, for formats other than CSV and Parquet; see
            `PassesRecord`.
        classes: class names of numbered labels, in the order of the model.
        frame_list: a file of frame ids (relative to the folder of `path`) for results without
            frame ids.
        rename: maps category names of the record to those of the project, e.g. {"car": "Car"};
            other names stay unchanged.
        axes: axes of boxes in the LiDAR frame: "forward-left" (x forward, y left), or
            "right-forward" as in nuScenes' LiDAR frame.
        rotation_y: who computed rotation_y of KITTI result files, see `curate.frames.RotationY`;
            None for the meaning in the data set's label files.
        version: the version of mmdetection3d, "0.x" or "1.x", for results that do not show it.
        ignored: whether to "drop" or "keep" ST3D's boxes with a negative category.
        shift: SHIFT_COOR of ST3D's data set configuration, [x, y, z] in metres.
        frame_name: name of a frame of Argoverse 2, e.g. "{log_id}_{timestamp_ns}".
        sigmoid: whether scores are logits; they become probabilities first.
        augmented: folder of `curate augment` with results of the copies; in place of `passes`.
        frame_ids: the frames of the data set; recorded frames are matched with them in the
            spellings of `curate.datasets.frame_names`, and those of no frame are reported.
        only_these: whether results of other frames are an error.
        calibration: returns the calibration of a frame id; needed for views in the formats of
            KITTI and nuScenes.
        wants_views: whether the run needs a second pass; if it is missing, a warning is logged.

    Raises:
        DataError: if a file is missing or malformed, or none of its frames is in the data set.
        ConfigError: if an option is invalid or missing.
    """

    needs_points = False

    def __init__(
        self,
        path: StrPath,
        minimum_score: Share = 0.0,
        *,
        kind: str = "auto",
        passes: Sequence[Mapping[str, Any]] = (),
        classes: Sequence[str] = (),
        frame_list: str | None = None,
        rename: Mapping[str, str] | None = None,
        axes: Axes = "forward-left",
        rotation_y: RotationY | None = None,
        version: str | None = None,
        ignored: Literal["drop", "keep"] = "drop",
        shift: Sequence[float] = (0.0, 0.0, 0.0),
        frame_name: str | None = None,
        sigmoid: bool = False,
        augmented: StrPath | None = None,
        frame_ids: Sequence[str] = (),
        only_these: bool = False,
        calibration: Callable[[str], Calibration] | None = None,
        wants_views: bool = True,
    ) -> None:
        check_kind(kind)
        if axes not in _AXES:
            raise ConfigError(f"detector.options.axes '{axes}': use one of {', '.join(_AXES)}")
        if rotation_y is not None:
            check_rotation_y(rotation_y, "detector.options.rotation_y")
        self._rotation_y = rotation_y
        self.path = Path(path)
        self.minimum_score = minimum_score
        self.rename = dict(rename or {})
        self.sigmoid = sigmoid
        self._to_lidar_axes = _AXES[axes]
        self._calibration = calibration
        self._wants_views = wants_views
        listed = self.path.parent / frame_list if frame_list else None
        check_frame_name(frame_name)
        options = ReadOptions(
            tuple(classes), listed, sigmoid, version, ignored, shift, frame_name, frame_ids
        )
        self._record = _open(self.path, kind, options, passes)
        # The name in the record of each frame that has another one there.
        found = self._match(FrameNames.of(frame_ids), only_these=only_these)
        self._record.check(found)
        self._recorded_as = {frame: name for name, frame in found.items() if name != frame}
        self._copies: _Copies | None = None
        if augmented is not None:
            if passes:
                raise ConfigError(
                    "detector.options.passes and detector.augmented are both set; remove one of "
                    "them"
                )
            folder = Path(augmented)
            manifest = Manifest.read(folder)
            places = [results_of(view, folder) for view in range(manifest.drawn.views)]
            views = [
                RecordedDetector(
                    place,
                    minimum_score,
                    kind=kind,
                    classes=classes,
                    frame_list=_list_of_view(place, frame_list),
                    rename=rename,
                    axes=axes,
                    version=version,
                    ignored=ignored,
                    shift=shift,
                    frame_name=frame_name,
                    sigmoid=sigmoid,
                    frame_ids=frame_ids,
                )
                for place in places
            ]
            self._copies = _Copies(folder, manifest, views)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the recorded frames, in sorted order, by the names that the record gives them."""
        return tuple(self._record.frame_ids())

    def missing_frames(self, frame_ids: Iterable[str]) -> tuple[str, ...]:
        """Return those of the frames that have no result, in the given order."""
        recorded = set(self._record.frame_ids())
        return tuple(
            frame for frame in frame_ids if self._recorded_as.get(frame, frame) not in recorded
        )

    @property
    def views_of_copies(self) -> "Sequence[RecordedDetector]":
        """The results of each view of a folder of augmented copies; empty without one."""
        return self._copies.views if self._copies else ()

    def lacks_copy(self, frame_id: str) -> bool:
        """Return whether there are augmented copies, but none of this frame."""
        return self._copies is not None and frame_id not in self._copies.manifest.frames

    def category_names(self) -> frozenset[str]:
        """Return the category names of all recorded boxes, after `rename`.

        Raises:
            DataError: if a file cannot be read.
        """
        return frozenset().union(*self.names_by_path().values())

    def names_by_path(self) -> Mapping[Path, frozenset[str]]:
        """Return the category names in the results of the frames and in those of each view.

        Raises:
            DataError: if a file cannot be read.
        """
        names = self._record.category_names()
        own = frozenset(self.rename.get(name, name) for name in names)
        return {
            self.path: own,
            **{view.path: view.category_names() for view in self.views_of_copies},
        }

    def predict(self, frame: Frame) -> Detections:
        """Return the stored result of the original frame; `frame.points` is not used.

        Raises:
            DataError: if the frame was not recorded, or its result is malformed.
        """
        return self._found(frame.frame_id, lambda _: frame.calibration)

    def views(self, frame_id: str) -> Sequence[tuple[Similarity, Detections]]:
        """Return the recorded augmented copies of the frame, in the order of their numbers.

        Raises:
            DataError: if the frame was not recorded, or its result is malformed.
        """
        if self._copies:
            return [
                (similarity, self.found_in_copy(frame_id, view))
                for view, similarity in enumerate(self._copies.of(frame_id))
            ]
        views = self._record.views(self._recorded_as.get(frame_id, frame_id))
        if self._wants_views and not views and not self._record.has_views:
            warn_once(
                f"{self.path}: no second pass over augmented copies, so no label has a consistency "
                "loss. Methods that need one give every label weight 0 unless solve.self_paced = "
                "false. Write the copies with `curate augment`, and set detector.augmented"
            )
        return [
            (similarity, self._detections(frame_id, result, self._own_calibration))
            for similarity, result in views
        ]

    def predict_recorded(self, frame_id: str) -> Detections:
        """Return the stored result of a frame by its name; see `predict`."""
        return self._found(frame_id, self._own_calibration)

    def found_in_copy(
        self, frame_id: str, view: int, rotation_y: RotationY | None = None
    ) -> Detections:
        """Return the detections of an augmented copy, in the copy's frame of reference.

        Args:
            frame_id: the frame.
            view: number of the copy, from 0.
            rotation_y: meaning of rotation_y in place of the configured one.

        Raises:
            DataError: if the copy was not recorded, or its result is malformed.
            ConfigError: if there is no folder of augmented copies.
        """
        if self._copies is None:
            raise ConfigError(f"{self.path}: detector.augmented is not set")
        similarity = self._copies.of(frame_id)[view]
        meaning = rotation_y or self._rotation_y or self._copies.manifest.rotation_y

        def calibration(name: str) -> Calibration:
            copied = augmented_calibration(self._own_calibration(name), similarity)
            return replace(copied, rotation_y=meaning)

        return self._copies.views[view]._found(frame_id, calibration)  # noqa: SLF001 - same class

    def _own_calibration(self, frame_id: str) -> Calibration:
        if self._calibration is None:
            raise ConfigError(f"{self.path}: these results need the calibration of the frames")
        return self._calibration(frame_id)

    def _found(self, frame_id: str, calibration: Callable[[str], Calibration]) -> Detections:
        """Return the stored result of a frame, or of a copy with this calibration."""
        result = self._record.result(self._recorded_as.get(frame_id, frame_id))
        return self._detections(frame_id, result, calibration)

    def _detections(
        self,
        frame_id: str,
        result: RecordedResult,
        calibration: Callable[[str], Calibration],
    ) -> Detections:
        """Return a result in the LiDAR frame, with renamed categories, without low scores."""
        if not isinstance(result, Detections):
            result = self._in_lidar(frame_id, result, calibration(frame_id))
        elif self._to_lidar_axes != Similarity():
            result = replace(result, boxes=self._to_lidar_axes.apply_to_boxes(result.boxes))
        place = f"{self.path}: frame {frame_id}"
        scores = to_probabilities(result.scores, sigmoid=self.sigmoid)
        if problem := describe_invalid_scores(scores.min(initial=0), scores.max(initial=0)):
            raise DataError(f"{place}: {problem}")
        result = replace(result, scores=scores)
        if self.rename:
            names = [self.rename.get(name, name) for name in result.categories.tolist()]
            result = replace(result, categories=as_categories(names))
        kept = result.select(np.flatnonzero(result.scores >= self.minimum_score))
        _check_repeated(place, kept)
        return kept

    def _in_lidar(
        self, frame_id: str, result: KittiObjects | ForeignBoxes, calibration: Calibration
    ) -> Detections:
        """Return a result in the LiDAR frame of reference."""
        if not isinstance(result, KittiObjects):
            return result.in_lidar(calibration)
        place = f"{self.path}: frame {frame_id}"
        with error_prefix(place):
            found = to_detections(result, calibration, self._rotation_y)
        return as_detections(place, found.boxes, found.scores, found.categories)

    def _match(self, frames: FrameNames, *, only_these: bool) -> Mapping[str, str]:
        """Return the frame of each recorded name.

        Recorded frames that are not in the data set are reported by a warning.

        Raises:
            DataError: if no recorded frame is in the data set, a name fits several frames, or with
                `only_these`, a recorded frame is not in the data set.
        """
        names = list(self._record.frame_ids())
        if not len(frames):
            parts = {name: last_part(name) for name in names}
            return parts if len({*parts.values()}) == len(names) else {name: name for name in names}
        found, unmatched = frames.match(names, self.path)
        examples = ", ".join(unmatched[:3]) + (", ..." if len(unmatched) > 3 else "")
        if unmatched and only_these:
            raise DataError(
                f"{self.path}: results for frames that were not requested ({examples}); the "
                "detector must read the frames that it is given, not the whole data set, and write "
                "logs and other files elsewhere"
            )
        if unmatched and not found:
            raise DataError(
                f"{self.path}: results for frames that do not exist ({examples})"
                f"{frames.nearest(unmatched[0])}"
            )
        if unmatched:
            warn_once(
                f"{self.path}: {len(unmatched)} of {len(names)} results are for frames that the "
                f"data set does not have ({examples}); they are left out"
            )
        return found


@dataclass(frozen=True)
class _Copies:
    """The results of augmented copies: the folder, its manifest, and a detector per view."""

    folder: Path
    manifest: Manifest
    views: Sequence[RecordedDetector]

    def of(self, frame_id: str) -> Sequence[Similarity]:
        """Return A of each copy of a frame."""
        if frame_id not in self.manifest.frames:
            raise DataError(
                f"{self.folder}: no copies of frame {frame_id}; these are copies of the split "
                f"{self.manifest.split}"
            )
        return self.manifest.frames[frame_id]


def _list_of_view(results: Path, frame_list: str | None) -> str | None:
    """Return the list of frames of a view's results: beside them, or that of the copies."""
    if frame_list is None:
        return None
    own = Path(frame_list).name
    return own if (results.parent / own).exists() else "ImageSets/test.txt"


def _check_repeated(place: str, found: Detections) -> None:
    """Raise DataError if a box occurs twice, as in a file that was appended to itself."""
    numbers = np.column_stack([found.boxes, found.scores]).tolist()
    seen: set[tuple[Any, ...]] = set()
    for category, box in zip(found.categories.tolist(), map(tuple, numbers), strict=True):
        if (category, *box) in seen:
            x, y, score = (round(number, 3) for number in (*box[:2], box[-1]))
            raise DataError(
                f"{place}: the {category} of score {score} at x {x}, y {y} occurs twice; were the "
                "results written twice into one file?"
            )
        seen.add((category, *box))


def _open(
    path: Path, kind: str, options: ReadOptions, passes: Sequence[Mapping[str, Any]]
) -> Record:
    kind = detect_kind(path) if kind == "auto" else kind
    if kind not in _TABLES:
        return PassesRecord.read(path, kind, options, passes)
    if passes:
        raise ConfigError(
            f"{path}: a table contains its augmented copies as views 1, 2, ...; remove passes from "
            "detector.options"
        )
    return _TABLES[kind](path, options.sigmoid)
