"""The detector that answers from a record."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from curate.datasets.kitti.labels import KittiObjects, to_detections
from curate.detections import Detections, as_categories
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
from curate.errors import ConfigError, DataError
from curate.files.paths import StrPath
from curate.frames import Calibration, Frame
from curate.geometry.similarity import Similarity

_log = logging.getLogger(__name__)
# Formats with the augmented copies in the same file.
_TABLES: Mapping[str, Callable[[Path], "Record"]] = {
    "csv": TableRecord.read,
    "parquet": ParquetRecord.read,
}

# What brings boxes in these axes into ours.
_TURNS = {
    "forward-left": Similarity(),
    "right-forward": Similarity(rotation_rad=-np.pi / 2),
}


class Record(Protocol):
    """The answers for frames, and for augmented copies of them."""

    @property
    def has_views(self) -> bool:
        """Whether augmented copies were recorded."""
        ...

    def frame_ids(self) -> Iterable[str]:
        """Return the recorded frames, in sorted order."""
        ...

    def answer(self, frame_id: str) -> RecordedResult:
        """For the frame as it is; DataError where nothing was recorded."""
        ...

    def views(self, frame_id: str) -> Sequence[tuple[Similarity, RecordedResult]]:
        """For each augmented copy, in its own frame of reference."""
        ...


class RecordedDetector:
    """A `Detector` and `RecordedViews` that answers from files.

    Args:
        path: a CSV or Parquet file, a folder of KITTI result files, OpenPCDet's result.pkl, or
            mmdetection3d's results (pickle of arrays, JSON, or folder of JSON), or nuScenes'
            results (JSON).
        minimum_score: boxes below it are left out.
        kind: of the format: csv, parquet, kitti, openpcdet, mmdetection3d, nuscenes, or auto to
            tell it by suffix and contents.
        passes: of other formats than these tables, the passes over augmented copies; see
            `PassesRecord`.
        classes: the names behind numbered labels, in the order of the model.
        frame_list: a file of frame ids (relative to the folder of `path`) for results that name no
            frames.
        rename: the record's names of categories and ours, e.g. {"car": "Car"}; names that are not
            in it stay.
        axes: of boxes in a LiDAR's frame: "forward-left" (x forward, y left), or "right-forward" as
            nuScenes' sensor has them.
        frame_ids: of the data set; recorded frames that are not among them are reported.
        calibration: of a frame of the data set, by its name, for views in KITTI's or nuScenes'
            form.
        wants_views: whether somebody counts on a second pass; one that is missing is then said.

    Raises:
        DataError: a file is missing or malformed, or none of its frames is in the data set.
        ConfigError: an option is wrong or missing.
    """

    def __init__(
        self,
        path: StrPath,
        minimum_score: float = 0.0,
        *,
        kind: str = "auto",
        passes: Sequence[Mapping[str, Any]] = (),
        classes: Sequence[str] = (),
        frame_list: str | None = None,
        rename: Mapping[str, str] | None = None,
        axes: str = "forward-left",
        frame_ids: Sequence[str] = (),
        calibration: Callable[[str], Calibration] | None = None,
        wants_views: bool = True,
    ) -> None:
        check_kind(kind)
        if axes not in _TURNS:
            raise ConfigError(f"detector.options.axes '{axes}': use one of {', '.join(_TURNS)}")
        self.path = Path(path)
        self.minimum_score = minimum_score
        self.rename = dict(rename or {})
        self._turn = _TURNS[axes]
        self._calibration = calibration
        self._wants_views = wants_views
        listed = self.path.parent / frame_list if frame_list else None
        self._record = _open(self.path, kind, ReadOptions(tuple(classes), listed), passes)
        if frame_ids:
            self._report_unmatched(frame_ids)

    def frame_ids(self) -> tuple[str, ...]:
        """Return the recorded frames, in sorted order."""
        return tuple(self._record.frame_ids())

    def predict(self, frame: Frame) -> Detections:
        """What was recorded for the frame as it is; `frame.points` are not looked at.

        Raises:
            DataError: nothing was recorded for the frame, or what was is malformed.
        """
        answer = self._record.answer(frame.frame_id)
        return self._detections(frame.frame_id, answer, lambda _: frame.calibration)

    def views(self, frame_id: str) -> Sequence[tuple[Similarity, Detections]]:
        """Return the recorded augmented copies of the frame, in the order of their numbers.

        Raises:
            DataError: nothing was recorded for the frame, or what was is malformed.
        """
        views = self._record.views(frame_id)
        if self._wants_views and not views and not self._record.has_views:
            _warn_once(
                f"{self.path}: no second pass over augmented copies, so no label has a consistency "
                "loss, and methods that need one weigh every label 0 unless solve.self_paced = "
                "false; passes in detector.options bring one"
            )
        return [
            (similarity, self._detections(frame_id, answer, self._calibration))
            for similarity, answer in views
        ]

    def _detections(
        self,
        frame_id: str,
        answer: RecordedResult,
        calibration: Callable[[str], Calibration] | None,
    ) -> Detections:
        """Return the answer in the LiDAR frame, with our names, from the lowest score on."""
        if not isinstance(answer, Detections):
            if calibration is None:
                raise ConfigError(f"{self.path}: these results need the calibration of the frames")
            answer = self._placed(frame_id, answer, calibration(frame_id))
        elif self._turn != Similarity():
            answer = replace(answer, boxes=self._turn.apply_to_boxes(answer.boxes))
        if self.rename:
            names = [self.rename.get(name, name) for name in answer.categories.tolist()]
            answer = replace(answer, categories=as_categories(names))
        kept = answer.select(np.flatnonzero(answer.scores >= self.minimum_score))
        _check_repeated(f"{self.path}: frame {frame_id}", kept)
        return kept

    def _placed(
        self, frame_id: str, answer: KittiObjects | ForeignBoxes, calibration: Calibration
    ) -> Detections:
        """Return the answer in the LiDAR's frame of reference."""
        if not isinstance(answer, KittiObjects):
            return answer.in_lidar(calibration)
        found = to_detections(answer, calibration)
        place = f"{self.path}: frame {frame_id}"
        return as_detections(place, found.boxes, found.scores, found.categories)

    def _report_unmatched(self, frame_ids: Sequence[str]) -> None:
        """State which recorded frames the data set does not have; DataError where it has none."""
        known = set(frame_ids)
        recorded = sum(1 for _ in self._record.frame_ids())
        strays = [name for name in self._record.frame_ids() if name not in known]
        few = ", ".join(strays[:3]) + (", ..." if len(strays) > 3 else "")
        if strays and len(strays) == recorded:
            raise DataError(
                f"{self.path}: results for frames that do not exist ({few}); the data set's are "
                f"named like {frame_ids[0]}"
            )
        if strays:
            _warn_once(
                f"{self.path}: {len(strays)} of {recorded} results are for frames that the "
                f"data set does not have ({few}); they are left out"
            )


def _check_repeated(place: str, found: Detections) -> None:
    """Raise DataError if a box comes twice, as all do in a file that was appended to itself."""
    numbers = np.column_stack([found.boxes, found.scores]).tolist()
    seen: set[tuple[Any, ...]] = set()
    for category, box in zip(found.categories.tolist(), map(tuple, numbers), strict=True):
        if (category, *box) in seen:
            x, y, score = (round(number, 3) for number in (*box[:2], box[-1]))
            raise DataError(
                f"{place}: the {category} of score {score} at x {x}, y {y} comes twice; were the "
                "results written twice into one file?"
            )
        seen.add((category, *box))


def _open(
    path: Path, kind: str, reading: ReadOptions, passes: Sequence[Mapping[str, Any]]
) -> Record:
    told = detect_kind(path) if kind == "auto" else kind
    if told not in _TABLES:
        return PassesRecord.read(path, told, reading, passes)
    if passes:
        raise ConfigError(f"{path}: a table holds its augmented copies itself, as views 1, 2, ...")
    return _TABLES[told](path)


@cache
def _warn_once(message: str) -> None:
    """Once per process, whatever the number of stages and frames."""
    _log.warning(message)
