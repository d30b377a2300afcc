"""curate init: create a workspace for a data set."""

from pathlib import Path
from typing import Annotated, Any, Optional

import typer

from curate.segmenters.classes import CLASS_MAPS
from pipelines.commands.options import JsonOption, complete, one_of, registered
from pipelines.registry import DATASETS, DETECTORS, SEGMENTERS, detector_and_preset
from pipelines.reports.terminal import print_json, print_line
from pipelines.workspace.splits import SPLITS, count_frames


def init(
    directory: Annotated[Path, typer.Argument(help="Folder of the new workspace.")],
    root: Annotated[Path, typer.Option(help="Folder of the data set.")],
    dataset: Annotated[
        str,
        typer.Option(
            help=f"Kind of data set: {registered(DATASETS)}.",
            autocompletion=complete(DATASETS.classes),
        ),
    ] = "kitti",
    dataset_option: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help="Option of the data set, as NAME=VALUE, e.g. cameras=all; repeatable."),
    ] = None,
    labeled: Annotated[
        str,
        typer.Option(
            help="Share of the training frames that is labeled, or a file with their ids."
        ),
    ] = "0.04",
    val: Annotated[
        str,
        typer.Option(help="The same for validation frames; default: the val list of the data set."),
    ] = "",
    calibration: Annotated[
        str,
        typer.Option(
            help="Share of the validation frames to set aside for `curate calibrate`, or a file "
            "with their ids."
        ),
    ] = "",
    split_by: Annotated[
        str,
        typer.Option(
            help="What the split keeps together: sequence (if the data set has them) or frame."
        ),
    ] = "sequence",
    follow_links: Annotated[
        bool,
        typer.Option("--follow-links", help="Follow symbolic links that lead out of the root."),
    ] = False,
    seed: Annotated[
        int, typer.Option(min=0, help="Random seed of the split and of all later stages.")
    ] = 0,
    detector: Annotated[
        str,
        typer.Option(
            help=f"Detector: {registered(DETECTORS)}; or a preset to train, such as "
            "voxel-rcnn-small (docs/detectors.md).",
            autocompletion=complete(DETECTORS.classes),
        ),
    ] = "pillars",
    detector_path: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Checkpoint, model file or results of an external detector."),
    ] = None,
    unseen: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Labeled frames that an external detector was not trained on, for `curate "
            "calibrate`: a file with their ids, or 'labeled' for all."
        ),
    ] = None,
    detector_config: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Model file (YAML) of a checkpoint of OpenPCDet."),
    ] = None,
    segmenter: Annotated[
        str,
        typer.Option(
            help=f"Segmenter: {registered(SEGMENTERS, 'simulated', 'none')}.",
            autocompletion=complete((*SEGMENTERS.classes, "simulated", "none")),
        ),
    ] = "none",
    segmenter_path: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Model file, folder of saved maps, or file of masks, as the segmenter needs it."
        ),
    ] = None,
    segmenter_classes: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help=f"Data set that defines the segmenter's class ids: {one_of(CLASS_MAPS)}.",
            autocompletion=complete(CLASS_MAPS),
        ),
    ] = None,
    settings: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--set", help="Any setting of curate.toml, as section.key=value; repeatable."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Create a workspace: settings, database, and the choice of labeled frames.

    Ground truth of unlabeled frames is never read. Without a segmenter, only the point prior is
    used.

    Example: curate init work --root data/simulated --labeled 0.06 --segmenter simulated
    """
    from curate.category_names import listed
    from curate.errors import ConfigError
    from pipelines.assembly import check_extensions, check_labels_format
    from pipelines.assessment.doctor import report_wrong_inputs
    from pipelines.assessment.missing_results import report_missing_results
    from pipelines.category_names import check_before_init, stored_names
    from pipelines.workspace.config import change_setting, make_config
    from pipelines.workspace.images import fit_priors, report_images
    from pipelines.workspace.setup import check_files, initialise
    from pipelines.workspace.workspace import open_dataset

    if not root.is_dir():
        raise ConfigError(f"--root {root}: no such folder")
    detector, preset = detector_and_preset(detector)
    run = {"seed": seed, "priors": ("points",) if segmenter == "none" else ("points", "semantic")}
    document: dict[str, Any] = {
        "dataset": {
            "kind": dataset,
            "root": root.resolve(),
            "split_by": split_by,
            "follow_links": follow_links,
            "options": dict(map(_option, dataset_option or ())),
        },
        "detector": {
            "name": detector,
            "path": detector_path and detector_path.resolve(),
            "unseen": _unseen(unseen),
            "options": _model_file(detector, detector_path, detector_config),
        },
        "segmenter": {
            "name": segmenter,
            "path": segmenter_path and segmenter_path.resolve(),
            "classes": segmenter_classes,
        },
        "train": {} if preset is None else {"preset": preset},
        "run": run,
    }
    for setting in settings or ():
        change_setting(document, setting)
    config = make_config(document, "curate init")
    check_extensions(config, directory.resolve())
    check_files(config)
    supplied = check_before_init(config)
    chosen = any(setting.partition("=")[0].strip() == "run.priors" for setting in settings or ())
    frames = open_dataset(config)
    if config.train.command is not None:
        check_labels_format(config, frames)
    config = fit_priors(config, frames, explicit=chosen)
    workspace = initialise(directory, config, labeled, val, calibration)
    report_missing_results(workspace, supplied)
    report_wrong_inputs(workspace)
    report_images(config, workspace.dataset, list(workspace.frames(*SPLITS)))
    counts = count_frames({split: workspace.frames(split) for split in SPLITS})
    objects = stored_names(workspace)
    if as_json:
        print_json({"workspace": str(workspace.root), "frames": counts, "objects": objects})
        return
    *first, last = (f"{count} {split}" for split, count in counts.items())
    print_line(f"{workspace.root}: {', '.join(first)} and {last} frames; settings in curate.toml")
    used = {name: count for name, count in objects.items() if name in config.dataset.categories}
    others = {name: count for name, count in objects.items() if name not in used}
    if objects:
        tail = f"; not in dataset.categories: {listed(others)}" if others else ""
        print_line(f"objects in the label files: {listed(used)}{tail}")


def _unseen(text: str | None) -> Path | str | None:
    """Return the value of --unseen: the word, or the path of a file."""
    from curate.errors import ConfigError

    if text in {None, "labeled"}:
        return text
    path = Path(str(text))
    if not path.is_file():
        raise ConfigError(f"--unseen {text}: no such file; give a file of frame ids, or labeled")
    return path.resolve()


def _model_file(detector: str, path: Path | None, config: Path | None) -> dict[str, str]:
    """Return the detector's option with its model file: the given one, or that beside the path."""
    from curate.errors import ConfigError

    if config is not None and not config.is_file():
        raise ConfigError(f"--detector-config {config}: no such file")
    if config is None and path is not None:
        DETECTORS.check_name(detector)
        beside = path.with_suffix(".yaml")
        config = beside if beside.is_file() and DETECTORS.takes(detector, "config") else None
    return {} if config is None else {"config": str(config.resolve())}


def _option(text: str) -> tuple[str, Any]:
    """Return name and value of NAME=VALUE; a value that is not valid TOML becomes a string."""
    import tomllib

    from curate.errors import ConfigError

    name, equals, value = text.partition("=")
    if not name or not equals:
        raise ConfigError(f"--dataset-option {text}: give NAME=VALUE, e.g. camera=CAM_BACK")
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name, value
