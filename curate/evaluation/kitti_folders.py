"""Folders of KITTI text files as the frames of an evaluation."""

from collections.abc import Sequence
from pathlib import Path

from curate.datasets.kitti.labels import KittiObjects, read_objects
from curate.errors import DataError
from curate.evaluation.kitti_ap import KittiEvaluation, evaluate
from curate.files.paths import StrPath


def evaluate_folders(
    labels: StrPath, results: StrPath, frame_ids: Sequence[str] | None = None
) -> KittiEvaluation:
    """Return KITTI's average precision of a folder of result files: image, aos, BEV and 3D.

    At KITTI's overlaps (Car 0.7, Pedestrian and Cyclist 0.5), for R11 and R40, on the CPU.
    Source: see `evaluate`, which takes other overlaps.

    Args:
        labels: folder with one `FRAME.txt` of 15 fields per line for each frame.
        results: folder with one `FRAME.txt` of 16 fields per line, the last a score.
        frame_ids: the frames to compare; by default all frames of the label folder.

    Raises:
        DataError: if a folder or file is missing, damaged or malformed.
    """
    _, truth, detections = read_folders(labels, results, frame_ids)
    return evaluate(truth, detections)


def read_folders(
    labels: StrPath, results: StrPath, frame_ids: Sequence[str] | None = None
) -> tuple[tuple[str, ...], list[KittiObjects], list[KittiObjects]]:
    """Return the frame ids of two folders, and the labels and results of each frame.

    A frame without a result file is an error, never silently left out: a partial run must not be
    scored as a whole one. A frame without detections has an empty result file.

    Args:
        labels: folder with one `FRAME.txt` of 15 fields per line for each frame.
        results: folder with one `FRAME.txt` of 16 fields per line, the last a score.
        frame_ids: the frames to read; None is all frames of the label folder, and then result
            files for other frames are an error too.

    Returns:
        The frame ids in sorted order, the labels and the results of each.

    Raises:
        DataError: if a folder or file is missing, damaged or malformed.
    """
    labels, results = Path(labels), Path(results)
    labelled, answered = _frame_ids(labels), _frame_ids(results)
    wanted = labelled if frame_ids is None else set(frame_ids)
    _require_files(wanted - labelled, labels, "label")
    if frame_ids is None:
        _require_files(answered - labelled, labels, "label")
    _require_files(wanted - answered, results, "result")
    ordered = tuple(sorted(wanted))
    return (
        ordered,
        [read_objects(labels / f"{frame_id}.txt") for frame_id in ordered],
        [read_objects(results / f"{frame_id}.txt", scored=True) for frame_id in ordered],
    )


def _frame_ids(folder: Path) -> set[str]:
    """Return the names of the text files in a folder."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; name one with a text file per frame")
    # macOS strews hidden ._ files over foreign disks.
    found = {path.stem for path in folder.glob("*.txt") if not path.name.startswith(".")}
    if not found:
        raise DataError(f"{folder}: holds no .txt files; name a folder with one per frame")
    return found


def _require_files(missing: set[str], folder: Path, kind: str) -> None:
    """Raise `DataError` where frames have no file."""
    if not missing:
        return
    first = min(missing)
    others = f" and {len(missing) - 1} other frames" if len(missing) > 1 else ""
    remedy = "write an empty one for a frame without objects, or name the frames with --frames"
    raise DataError(f"{folder / first}.txt: no {kind} file for frame {first}{others}; {remedy}")
