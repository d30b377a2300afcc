"""curate init: a workspace over a data set."""

from pathlib import Path
from typing import Annotated, Any, Optional

import typer


def init(
    directory: Annotated[Path, typer.Argument(help="Folder for the workspace.")],
    root: Annotated[Path, typer.Option(help="Folder of the data set.")],
    dataset: Annotated[
        str, typer.Option(help="kitti, kitti-raw, folder or module:Class.")
    ] = "kitti",
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
        str, typer.Option(help="onnx, saved, simulated, degraded, none or module:Class.")
    ] = "none",
    segmenter_path: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Model, or folder of saved maps."),
    ] = None,
    segmenter_classes: Annotated[
        str, typer.Option(help="voc, coco, cityscapes or simulated.")
    ] = "voc",
) -> None:
    """Make a workspace: curate.toml, curate.db, which frames are labeled, their ground truth.

    Ground truth of unlabeled frames is not read. Without a segmenter only the point prior is asked.

    Example: curate init work --root data/simulated --labeled 0.06 --segmenter simulated
    """
    from curate.errors import ConfigError
    from pipelines.config import make_config
    from pipelines.setup import initialise

    if not root.is_dir():
        raise ConfigError(f"--root {root}: no such folder")
    document: dict[str, Any] = {
        "dataset": {
            "kind": dataset,
            "root": root.resolve(),
            "split_by": split_by,
            "follow_links": follow_links,
        },
        "detector": {"name": detector, "path": detector_path and detector_path.resolve()},
        "segmenter": {
            "name": segmenter,
            "path": segmenter_path and segmenter_path.resolve(),
            "classes": segmenter_classes,
        },
        "run": {
            "seed": seed,
            "priors": ("points",) if segmenter == "none" else ("points", "semantic"),
        },
    }
    workspace = initialise(directory, make_config(document, "curate init"), labeled, val)
    counts = {split: len(workspace.frames(split)) for split in ("labeled", "unlabeled", "val")}
    typer.echo(
        f"{workspace.root}: {counts['labeled']} labeled, {counts['unlabeled']} unlabeled and "
        f"{counts['val']} val frames; settings in curate.toml"
    )


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(init)
