"""curate evaluate: compute KITTI average precision."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pipelines.commands.options import (
    ExecutorOption,
    JsonOption,
    WorkersOption,
    WorkspaceOption,
    open_workspace,
)

if TYPE_CHECKING:
    from curate.evaluation.kitti_ap import KittiEvaluation
    from curate.evaluation.kitti_folders import SensorFolders
    from pipelines.assessment.evaluation import ValObjects
    from pipelines.reports.evaluation_report import EvaluationReport
    from pipelines.workspace.workspace import Workspace

OUTCOMES = {"tp": "detected", "fn": "missed", "ignored": "ignored"}


def evaluate(
    labels: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Folder of KITTI label files to compare with --results; needs no workspace."
        ),
    ] = None,
    results: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder of KITTI result files, one per label file."),
    ] = None,
    frames: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="File that lists the frame ids to compare; default: all files of --labels."
        ),
    ] = None,
    categories: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Categories to evaluate in --labels, separated by commas; default: "
            "Car,Pedestrian,Cyclist. A workspace uses dataset.categories."
        ),
    ] = None,
    min_overlap: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            help="IoU that a correct detection of a category exceeds, such as Bus=0.7; repeatable. "
            "Default: evaluation.overlaps, else 0.7 for Car and 0.5 for others."
        ),
    ] = None,
    difficulty: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Levels of difficulty: kitti (needs 2D boxes), points (LiDAR points in the "
            "object) or distance. Default: evaluation.difficulty, else kitti."
        ),
    ] = None,
    minimum_points: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="LiDAR points of an object of each level, for --difficulty points, such as 6,1."
        ),
    ] = None,
    distance_limits: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Metres between two ranges, for --difficulty distance, such as 30,50."),
    ] = None,
    calib: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Folder of KITTI calibration files, to project 3D boxes without a 2D box; "
            "default: the folder calib beside --labels."
        ),
    ] = None,
    images: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Folder of images, for their size; default: the folder image_2 beside --labels."
        ),
    ] = None,
    image_size: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Size of all images, such as 1242x375, instead of --images."),
    ] = None,
    velodyne: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Folder of point clouds, for --difficulty points; default: the folder velodyne "
            "beside --labels."
        ),
    ] = None,
    round_number: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--round", min=1, help="Evaluate the stored val predictions of this round."),
    ] = None,
    checkpoint: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Checkpoint to run on the val frames; default: the newest."),
    ] = None,
    store: Annotated[
        bool,
        typer.Option("--store", help="Store AP and the outcome of every object in the database."),
    ] = False,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compute KITTI's average precision (image, aos, bev, 3d; R40 and R11) and recall.

    Without options the newest checkpoint is run on the val frames. With --labels and --results,
    every frame needs a file in both folders, an empty one if it has no objects; --frames takes a
    list such as ImageSets/val.txt. Detections with equal scores share one threshold.

    A table shows how many objects and results count, and why others do not. A figure that cannot
    be computed is "-", and null in JSON: AP of a category in which no object counts, image AP with
    --difficulty points or distance. Objects without a 2D box get that of the projected 3D box, if
    the calibration is known.

    After --store, list the missed objects with: curate query "SELECT frame, category, x, y,
    occluded, iou FROM evaluation WHERE outcome = 'fn'". Outcomes are tp, fp, fn and ignored, by 3D
    IoU at the level with the most objects (hard), for detections of every score.

    Example: curate evaluate --labels data/label_2 --results out/results --json
    """
    from curate.errors import ConfigError
    from pipelines.reports.evaluation_report import print_evaluation

    of_folders = {
        "--frames": frames,
        "--categories": categories,
        "--calib": calib,
        "--images": images,
        "--image-size": image_size,
        "--velodyne": velodyne,
    }
    rules = _rules(min_overlap, difficulty, minimum_points, distance_limits)
    if (labels is None) != (results is None):
        raise ConfigError("evaluate: --labels and --results go together")
    if labels is not None and results is not None:
        if store:
            raise ConfigError("evaluate: --store needs a workspace, not --labels and --results")
        from curate.evaluation.kitti_folders import SensorFolders

        sensors = SensorFolders(calib, images, _size(image_size), velodyne)
        names = _names(categories)
        found = _evaluate_folders(labels, results, frames, names, rules, sensors)
    else:
        for option, value in of_folders.items():
            if value is not None:
                raise ConfigError(f"evaluate: {option} goes with --labels and --results")
        if round_number is not None and checkpoint is not None:
            raise ConfigError("evaluate: give --round or --checkpoint, not both")
        from pipelines.category_names import check_names

        opened = open_workspace(workspace, executor, workers)
        check_names(opened)
        opened = opened.with_settings("evaluation", **rules) if rules else opened
        found = _evaluate_val(opened, round_number, checkpoint, store=store)
    print_evaluation(found, as_json=as_json)


def _rules(
    overlaps: Sequence[str] | None,
    difficulty: str | None,
    minimum_points: str | None,
    distance_limits: str | None,
) -> dict[str, Any]:
    """Return the given options as settings of the section evaluation."""
    given = {
        "overlaps": _overlaps(overlaps) if overlaps else None,
        "difficulty": difficulty,
        "minimum_points": _numbers("--minimum-points", minimum_points, int),
        "distance_limits": _numbers("--distance-limits", distance_limits, float),
    }
    return {name: value for name, value in given.items() if value is not None}


def _overlaps(given: Sequence[str]) -> dict[str, float]:
    from curate.errors import ConfigError

    found = {}
    for each in given:
        category, equals, number = each.rpartition("=")
        try:
            found[category] = float(number)
        except ValueError:
            equals = ""
        if not equals:
            raise ConfigError(f"--min-overlap {each}: write CATEGORY=IOU, such as Bus=0.7")
    return found


def _numbers(option: str, text: str | None, kind: type[float]) -> tuple[float, ...] | None:
    from curate.errors import ConfigError

    if text is None:
        return None
    try:
        return tuple(kind(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(f"{option} {text}: write numbers separated by commas") from error


def _names(categories: str | None) -> tuple[str, ...]:
    from curate.detections import CATEGORIES
    from curate.errors import ConfigError

    if categories is None:
        return CATEGORIES
    found = tuple(dict.fromkeys(name.strip() for name in categories.split(",") if name.strip()))
    if not found:
        raise ConfigError(f"--categories {categories}: write names separated by commas")
    return found


def _size(text: str | None) -> tuple[int, int] | None:
    from curate.errors import ConfigError

    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise ConfigError(f"--image-size {text}: write WIDTHxHEIGHT in pixels, such as 1242x375")
    return int(width), int(height)


def _evaluate_folders(
    labels: Path,
    results: Path,
    frames: Path | None,
    categories: tuple[str, ...],
    rules: Mapping[str, Any],
    sensors: "SensorFolders",
) -> "EvaluationReport":
    """Return the evaluation of two folders."""
    from curate.errors import ConfigError, DataError
    from curate.evaluation.difficulties import open_difficulty
    from curate.evaluation.kitti_folders import load_folders
    from curate.evaluation.kitti_rules import overlaps_of
    from pipelines.assessment.evaluation import (
        ValObjects,
        orientation_notes,
        placeholder_notes,
        projection_notes,
    )
    from pipelines.reports.evaluation_report import EvaluationReport

    try:
        overlaps = overlaps_of(categories, rules.get("overlaps"))
    except ConfigError as error:
        raise ConfigError(f"--min-overlap: {error}; see --categories") from error
    limits = {name: rules[name] for name in ("minimum_points", "distance_limits") if name in rules}
    levels = open_difficulty(rules.get("difficulty", "kitti"), **limits)
    try:
        loaded = load_folders(
            labels,
            results,
            categories=categories,
            difficulty=levels,
            sensors=sensors,
            frame_list=frames,
        )
    except DataError as error:
        if "unknown category" in str(error):
            raise DataError(f"{error}; --categories evaluates other names") from error
        raise
    objects = ValObjects(loaded.labels, loaded.results, levels, overlaps, loaded.points)
    notes = projection_notes(*loaded.projected)
    if levels.in_image:
        notes += placeholder_notes(loaded.labels, loaded.results)
    return EvaluationReport(
        _compare(objects),
        f"{results} on {len(loaded.frame_ids)} frames",
        (*notes, *orientation_notes(loaded.results, levels)),
        "give --calib and --images (or --image-size) to project the 3D boxes, or use "
        "--difficulty distance, which needs no 2D boxes",
    )


def _evaluate_val(
    workspace: "Workspace", round_number: int | None, checkpoint: Path | None, *, store: bool
) -> "EvaluationReport":
    """Return the evaluation on the val frames."""
    from curate.errors import WorkspaceError
    from pipelines.assessment.evaluation import detect_val, stored_val, val_objects
    from pipelines.assessment.store import store_evaluation
    from pipelines.engine.progress import Bar
    from pipelines.engine.rounds import newest_checkpoint
    from pipelines.reports.evaluation_report import EvaluationReport

    if round_number is not None:
        source = f"round {round_number}"
        detections = stored_val(workspace, round_number)
    else:
        path = checkpoint or newest_checkpoint(workspace)
        if path is not None and not path.exists():
            raise WorkspaceError(f"--checkpoint {path}: no such file")
        source = workspace.relative(path) if path else workspace.config.detector.name
        detections = detect_val(workspace, path, Bar())
    objects = val_objects(workspace, detections)
    found = _compare(objects)
    place = f"{source} on {len(detections)} val frames"
    if store:
        counts = store_evaluation(workspace, source, detections, objects, found)
        tail = ", ".join(f"{counts.get(name, 0)} {word}" for name, word in OUTCOMES.items())
        place += f"; stored as source '{source}': {tail} objects"
    remedy = "use --difficulty distance, which needs no 2D boxes"
    return EvaluationReport(found, place, objects.notes, remedy)


def _compare(objects: "ValObjects") -> "KittiEvaluation":
    """Return the evaluation; print a message if its code must be compiled first."""
    from curate.evaluation import kitti_ap, kitti_matching
    from curate.geometry.compiled import is_compiled

    kitti_ap.check_frames(objects.labels, objects.results)  # before the message below
    if not is_compiled(kitti_matching.add_counts):
        typer.echo("compiling the evaluation code (first use only, some seconds)", err=True)
    return objects.evaluate()
