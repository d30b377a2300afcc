"""curate init: a workspace over a data set."""

from pathlib import Path
from typing import Annotated, Any, Optional

import typer


def init(
    directory: Annotated[Path, typer.Argument(help="Folder for the workspace.")],
    root: Annotated[Path, typer.Option(help="Folder of the data set.")],
    dataset: Annotated[
        str, typer.Option(help="kitti, kitti-raw, folder, nuscenes or module:Class.")
    ] = "kitti",
    dataset_option: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help="NAME=VALUE of the data set, such as camera=CAM_BACK; repeatable."),
    ] = None,
    labeled: Annotated[
        str, typer.Option(help="Share of the training frames that is labeled, or a file of ids.")
    ] = "0.04",
    val: Annotated[
        str, typer.Option(help="Likewise for validation; default: the data set's own val list.")
    ] = "",
    split_by: Annotated[
        str, typer.Option(help="sequence, where the data set knows them; or frame, see check.")
    ] = "sequence",
    follow_links: Annotated[
        bool, typer.Option("--follow-links", help="Links may lead out of the root.")
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the split and of every later draw.")] = 0,
    detector: Annotated[
        str, typer.Option(help="pillars, onnx, recorded or module:Class.")
    ] = "pillars",
    detector_path: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="File or folder of a detector that you bring."),
    ] = None,
    segmenter: Annotated[
        str, typer.Option(help="onnx, saved, instances, simulated, none or module:Class.")
    ] = "none",
    segmenter_path: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Model, folder of saved maps, or file of masks."),
    ] = None,
    segmenter_classes: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Whose class numbers: voc, coco, coco-from-0, cityscapes, cityscapes-label-ids."
        ),
    ] = None,
    settings: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--set", help="Any setting of curate.toml, section.key=value; repeat it for several."
        ),
    ] = None,
) -> None:
    """Make a workspace: curate.toml, curate.db, which frames are labeled, their ground truth.

    Ground truth of unlabeled frames is not read. Without a segmenter only the point prior is asked.

    Example: curate init work --root data/simulated --labeled 0.06 --segmenter simulated
    """
    from curate.errors import ConfigError
    from pipelines.assembly import check_extensions
    from pipelines.workspace.config import change_setting, make_config
    from pipelines.workspace.setup import initialise

    if not root.is_dir():
        raise ConfigError(f"--root {root}: no such folder")
    run = {"seed": seed, "priors": ("points",) if segmenter == "none" else ("points", "semantic")}
    document: dict[str, Any] = {
        "dataset": {
            "kind": dataset,
            "root": root.resolve(),
            "split_by": split_by,
            "follow_links": follow_links,
            "options": dict(map(_option, dataset_option or ())),
        },
        "detector": {"name": detector, "path": detector_path and detector_path.resolve()},
        "segmenter": {
            "name": segmenter,
            "path": segmenter_path and segmenter_path.resolve(),
            "classes": segmenter_classes,
        },
        "run": run,
    }
    for setting in settings or ():
        change_setting(document, setting)
    config = make_config(document, "curate init")
    check_extensions(config)
    workspace = initialise(directory, config, labeled, val)
    counts = {split: len(workspace.frames(split)) for split in ("labeled", "unlabeled", "val")}
    typer.echo(
        f"{workspace.root}: {counts['labeled']} labeled, {counts['unlabeled']} unlabeled and "
        f"{counts['val']} val frames; settings in curate.toml"
    )


def _option(text: str) -> tuple[str, Any]:
    """Name and value, which is TOML where it can be and else a text; ConfigError without a =."""
    import tomllib

    from curate.errors import ConfigError

    name, equals, value = text.partition("=")
    if not name or not equals:
        raise ConfigError(f"--dataset-option {text}: give NAME=VALUE, e.g. camera=CAM_BACK")
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name, value


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(init)
