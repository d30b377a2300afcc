"""Evaluate folders of KITTI label and result files."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from curate.datasets.formats.frame_files import IMAGE_SUFFIXES
from curate.datasets.formats.images import read_image_size
from curate.datasets.frame_names import FrameNames, match_frame_list
from curate.datasets.kitti.calibration import read_calibration
from curate.datasets.kitti.dataset import read_points
from curate.datasets.kitti.labels import (
    KITTI_CATEGORIES,
    KittiObjects,
    read_objects,
    to_annotations,
)
from curate.errors import ConfigError, DataError
from curate.evaluation.difficulties import KITTI, Difficulty
from curate.evaluation.kitti_ap import KittiEvaluation, evaluate
from curate.evaluation.kitti_rules import MIN_OVERLAPS
from curate.evaluation.missing_boxes import ProjectedBoxes, with_projected_boxes, without_box
from curate.files.paths import StrPath
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.shapes import Int


@dataclass(frozen=True)
class SensorFolders:
    """Further folders of the frames, which only some evaluations need.

    Attributes:
        calib: one KITTI calibration file `FRAME.txt` per frame, for missing 2D boxes and points.
        images: one image per frame, for its size.
        image_size: (width, height) in pixels of all images, instead of `images`.
        velodyne: one point cloud `FRAME.bin` per frame, for levels by points.
        required: whether a frame without a file is an error; else the file is not used.
    """

    calib: StrPath | None = None
    images: StrPath | None = None
    image_size: tuple[int, int] | None = None
    velodyne: StrPath | None = None
    required: Collection[str] = ()

    def or_beside(self, labels: StrPath) -> "SensorFolders":
        """Return the folders, with calib, image_2 and velodyne beside `labels` where none is given.

        Raises:
            DataError: if a given folder does not exist.
        """
        given = [name for name in ("calib", "images", "velodyne") if getattr(self, name)]
        for name in given:
            folder = Path(getattr(self, name))
            if not folder.is_dir():
                raise DataError(f"{folder}: no such folder; use a folder with one file per frame")
        beside = Path(labels).absolute().parent
        calib, images, velodyne = (
            folder or (usual if usual.is_dir() else None)
            for folder, usual in (
                (self.calib, beside / "calib"),
                (self.images, beside / "image_2"),
                (self.velodyne, beside / "velodyne"),
            )
        )
        return SensorFolders(calib, images, self.image_size, velodyne, tuple(given))

    def file(self, name: str, frame_id: str, suffixes: Sequence[str]) -> Path | None:
        """Return the file of a frame in a folder; None if there is none and it is not required.

        Raises:
            DataError: if the file is missing in a folder that is required.
        """
        given: StrPath | None = getattr(self, name)
        if given is None:
            return None
        folder = Path(given)
        if name in self.required:
            return _sensor_file(folder, frame_id, suffixes)
        paths = (folder / f"{frame_id}{suffix}" for suffix in suffixes)
        return next((path for path in paths if path.is_file()), None)

    def size_of(self, frame_id: str) -> tuple[int, int] | None:
        """Return (width, height) of a frame's image in pixels; None if it is unknown."""
        if self.image_size is not None:
            return self.image_size
        path = self.file("images", frame_id, IMAGE_SUFFIXES)
        return None if path is None else read_image_size(path)


@dataclass(frozen=True)
class FolderFrames:
    """The objects of two folders, ready for an evaluation.

    Attributes:
        frame_ids: names of the frames.
        labels: the objects of each frame.
        results: the detections of each frame.
        points: the LiDAR points in each object of each frame; None if they are not needed.
        projected: for the labels and the results, the number of objects that had no 2D box, and of
            those that have one from the projection.
    """

    frame_ids: tuple[str, ...]
    labels: list[KittiObjects]
    results: list[KittiObjects]
    points: list[Int[np.ndarray, " _"]] | None
    projected: tuple[tuple[int, int], tuple[int, int]]


def evaluate_folders(
    labels: StrPath,
    results: StrPath,
    frame_ids: Sequence[str] | None = None,
    *,
    min_overlaps: Mapping[str, float] = MIN_OVERLAPS,
    difficulty: Difficulty = KITTI,
    sensors: SensorFolders | None = None,
) -> KittiEvaluation:
    """Return KITTI's average precision of a folder of result files: image, aos, BEV and 3D.

    Computes R11 and R40 on the CPU; for the sources, see `evaluate`.

    Args:
        labels: folder with one `FRAME.txt` for each frame, 15 fields per line.
        results: folder with one `FRAME.txt` for each frame, 16 fields per line; the last is the
            score.
        frame_ids: the frames to evaluate; by default all frames of the label folder.
        min_overlaps: the categories to evaluate, and the overlap that a true positive must exceed;
            KITTI's by default (Car 0.7, Pedestrian and Cyclist 0.5).
        difficulty: the levels of difficulty.
        sensors: see `load_folders`.

    Raises:
        DataError: if a folder or file is missing, damaged or malformed.
        ConfigError: if the levels need points, and there are no point clouds.
    """
    frames = load_folders(
        labels, results, frame_ids, tuple(min_overlaps), difficulty=difficulty, sensors=sensors
    )
    return evaluate(
        frames.labels,
        frames.results,
        min_overlaps=min_overlaps,
        difficulty=difficulty,
        points=frames.points,
    )


def load_folders(
    labels: StrPath,
    results: StrPath,
    frame_ids: Sequence[str] | None = None,
    categories: Collection[str] = tuple(MIN_OVERLAPS),
    *,
    difficulty: Difficulty = KITTI,
    sensors: SensorFolders | None = None,
    frame_list: StrPath | None = None,
) -> FolderFrames:
    """Return the objects of two folders, with what the levels of difficulty need.

    KITTI's levels need 2D boxes: missing ones come from the projected 3D box where the calibration
    and the size of the image are known. Levels by points need the point clouds and calibrations.

    Args:
        labels: see `read_folders`.
        results: see `read_folders`.
        frame_ids: see `read_folders`.
        categories: the evaluated categories; if they are not all KITTI's, every name may occur.
        difficulty: the levels of difficulty.
        sensors: further folders; by default calib, image_2 and velodyne beside the label folder.
        frame_list: see `read_folders`.

    Raises:
        DataError: if a folder or file is missing, damaged or malformed.
        ConfigError: if the levels need points, and there are no point clouds.
    """
    names = KITTI_CATEGORIES if KITTI_CATEGORIES.issuperset(categories) else None
    ordered, truth, detections = read_folders(
        labels, results, frame_ids, names, frame_list=frame_list
    )
    found = (sensors or SensorFolders()).or_beside(labels)
    nothing = ((0, 0), (0, 0))
    if difficulty.kind == "points":
        return FolderFrames(
            ordered, truth, detections, _points(ordered, truth, found, labels), nothing
        )
    if not difficulty.in_image:
        return FolderFrames(ordered, truth, detections, None, nothing)
    sides = tuple(_with_boxes(ordered, objects, found) for objects in (truth, detections))
    totals = tuple(
        (sum(each.missing for each in side), sum(each.projected for each in side)) for side in sides
    )
    of_labels, of_results = ([each.objects for each in side] for side in sides)
    return FolderFrames(ordered, of_labels, of_results, None, (totals[0], totals[1]))


def _with_boxes(
    frame_ids: Sequence[str], frames: Sequence[KittiObjects], sensors: SensorFolders
) -> list[ProjectedBoxes]:
    """Return the objects of each frame, with projected 2D boxes where they have none."""
    found = []
    for frame_id, objects in zip(frame_ids, frames, strict=True):
        projection = size = None
        if without_box(objects).any():
            path = sensors.file("calib", frame_id, (".txt",))
            size = sensors.size_of(frame_id)
            projection = None if path is None else read_calibration(path).projection
        found.append(with_projected_boxes(objects, projection, size))
    return found


def _points(
    frame_ids: Sequence[str],
    frames: Sequence[KittiObjects],
    sensors: SensorFolders,
    labels: StrPath,
) -> list[np.ndarray]:
    """Return the LiDAR points in each object of each frame."""
    if sensors.calib is None or sensors.velodyne is None:
        missing = "calib" if sensors.calib is None else "velodyne"
        raise ConfigError(
            f"levels by LiDAR points need calibrations and point clouds: {Path(labels)} has no "
            f"folder {missing} beside it; specify --calib and --velodyne, or use levels by distance"
        )
    counts = []
    for frame_id, objects in zip(frame_ids, frames, strict=True):
        calibration = read_calibration(_sensor_file(sensors.calib, frame_id, (".txt",)))
        points = read_points(_sensor_file(sensors.velodyne, frame_id, (".bin",)))
        counts.append(count_points_in_boxes(points, to_annotations(objects, calibration).boxes))
    return counts


def _sensor_file(folder: StrPath, frame_id: str, suffixes: Sequence[str]) -> Path:
    """Return the file of a frame; raise `DataError` if it is missing."""
    paths = [Path(folder) / f"{frame_id}{suffix}" for suffix in suffixes]
    found = next((path for path in paths if path.is_file()), None)
    if found is None:
        raise DataError(f"{paths[0]}: no such file; the evaluation of frame {frame_id} needs it")
    return found


def read_folders(
    labels: StrPath,
    results: StrPath,
    frame_ids: Sequence[str] | None = None,
    categories: Collection[str] | None = KITTI_CATEGORIES,
    *,
    frame_list: StrPath | None = None,
) -> tuple[tuple[str, ...], list[KittiObjects], list[KittiObjects]]:
    """Return the frame ids of two folders, and the labels and results of each frame.

    A frame without a result file is an error: otherwise a partial run would be scored like a
    complete one. A frame without detections needs an empty result file. Files and lists may spell
    a frame in the ways of `curate.datasets.frame_names`; its id is the name of its label file.

    Args:
        labels: folder with one `FRAME.txt` for each frame, 15 fields per line.
        results: folder with one `FRAME.txt` for each frame, 16 fields per line; the last is the
            score.
        frame_ids: the frames to read; None reads all frames of the label folder, and then result
            files of other frames are an error too.
        frame_list: a file with the frames to read, in place of `frame_ids`.
        categories: the allowed category names; None allows any.

    Returns:
        The sorted frame ids, the labels of each frame, and the results of each frame.

    Raises:
        DataError: if a folder or file is missing, damaged or malformed.
    """
    labels, results = Path(labels), Path(results)
    label_files = {path.stem: path for path in _text_files(labels)}
    frames = FrameNames(label_files)
    by_name = {path.stem: path for path in _text_files(results)}
    matched, unmatched = frames.match(by_name, results)
    result_files = {frame: by_name[name] for name, frame in matched.items()}
    if frame_list is not None:
        frame_ids = match_frame_list(Path(frame_list), frames, allow_missing=True)
        if not frame_ids:
            raise DataError(f"{frame_list}: lists no frames; write one frame id per line")
    if frame_ids is None:
        _require_files({*unmatched}, labels, "label")
        frame_ids = list(frames)
    selected = {frames.find(frame_id) or frame_id for frame_id in frame_ids}
    _require_files(selected - label_files.keys(), labels, "label")
    _require_files(selected - result_files.keys(), results, "result")
    ordered = tuple(sorted(selected))
    return (
        ordered,
        [read_objects(label_files[frame_id], categories=categories) for frame_id in ordered],
        [
            read_objects(result_files[frame_id], scored=True, categories=categories)
            for frame_id in ordered
        ],
    )


def _text_files(folder: Path) -> list[Path]:
    """Return the text files in a folder."""
    if not folder.is_dir():
        if folder.is_file():
            raise DataError(
                f"{folder}: a file, expected a folder with one text file per frame; evaluate other "
                f"formats in a workspace: curate init --detector recorded --detector-path {folder}"
            )
        raise DataError(f"{folder}: no such folder; use a folder with one text file per frame")
    # macOS creates hidden ._ files on disks of other systems.
    found = [path for path in folder.glob("*.txt") if not path.name.startswith(".")]
    if not found:
        raise DataError(f"{folder}: no .txt files; use a folder with one text file per frame")
    return found


def _require_files(missing: set[str], folder: Path, kind: str) -> None:
    """Raise `DataError` if files are missing."""
    if not missing:
        return
    first = min(missing)
    others = f" and {len(missing) - 1} other frames" if len(missing) > 1 else ""
    remedy = "write an empty file for a frame without objects, or list the frames with --frames"
    raise DataError(f"{folder / first}.txt: no {kind} file for frame {first}{others}; {remedy}")
