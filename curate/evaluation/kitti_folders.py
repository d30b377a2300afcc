"""Evaluate folders of KITTI label and result files."""

from collections.abc import Sequence
from pathlib import Path

from curate.datasets.frame_names import FrameNames, match_frame_list
from curate.datasets.kitti.labels import KittiObjects, read_objects
from curate.errors import DataError
from curate.evaluation.kitti_ap import KittiEvaluation, evaluate
from curate.files.paths import StrPath


def evaluate_folders(
    labels: StrPath, results: StrPath, frame_ids: Sequence[str] | None = None
) -> KittiEvaluation:
    """Return KITTI's average precision of a folder of result files: image, aos, BEV and 3D.

    Uses KITTI's IoU thresholds (Car 0.7, Pedestrian and Cyclist 0.5), R11 and R40, on the CPU.
    For other thresholds, and for the sources, see `evaluate`.

    Args:
        labels: folder with one `FRAME.txt` for each frame, 15 fields per line.
        results: folder with one `FRAME.txt` for each frame, 16 fields per line; the last is the
            score.
        frame_ids: the frames to evaluate; by default all frames of the label folder.

    Raises:
        DataError: if a folder or file is missing, damaged or malformed.
    """
    _, truth, detections = read_folders(labels, results, frame_ids)
    return evaluate(truth, detections)


def read_folders(
    labels: StrPath,
    results: StrPath,
    frame_ids: Sequence[str] | None = None,
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
        [read_objects(label_files[frame_id]) for frame_id in ordered],
        [read_objects(result_files[frame_id], scored=True) for frame_id in ordered],
    )


def _text_files(folder: Path) -> list[Path]:
    """Return the text files in a folder."""
    if not folder.is_dir():
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
