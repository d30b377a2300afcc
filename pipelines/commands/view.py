"""curate view: draw images or a 3D recording of frames."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, PolicyOption, WorkspaceOption, open_workspace
from pipelines.reports.terminal import print_json, print_line

if TYPE_CHECKING:
    from curate.viewing.chart_style import ImageFormat


def view(
    frames: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Argument(
            metavar="FRAME...", help="Frame ids, e.g. 000008, or numbers.", show_default=False
        ),
    ] = None,
    every: Annotated[
        bool,
        typer.Option(
            "--all", help="Draw the unlabeled frames that have labels, in the order of their ids."
        ),
    ] = False,
    limit: Annotated[int, typer.Option(min=1, help="With --all: at most this many frames.")] = 50,
    round_number: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            "--round", min=1, help="Number of the round; default: the last with predictions."
        ),
    ] = None,
    policy: PolicyOption = None,
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="File for one frame; default: in the folder pictures of the workspace."),
    ] = None,
    image_format: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            "--format", help="png, pdf or svg. Default: the suffix of --output, else png."
        ),
    ] = None,
    style: Annotated[
        str, typer.Option(help="Colours: dark, or paper with a white background.")
    ] = "dark",
    recording: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option("--rerun", help="Write one .rrd recording of all frames instead of images."),
    ] = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Draw frames: camera image and bird's eye view with all boxes, coloured by weight.

    Predictions are solid, repredictions dashed, ground truth dotted. Ground truth is drawn for
    labeled and val frames only. Objects that people accepted, moved or added have long dashes, and
    labels that they rejected are crossed out; the output lists these decisions. Each label shows
    its k, the K of `curate explain FRAME K`, and if there is room, its weight, score and LiDAR
    points. In PDF and SVG files, boxes and texts are vectors. A recording holds points, image,
    boxes and the evidence of each label, frame by frame; open it with `rerun FILE`
    (pip install 'curate-pseudo-labels[rerun]').

    Example: curate view 000008 --round 1 --policy pspsl --style paper --output 000008.pdf
    """
    from curate.errors import ConfigError
    from curate.viewing.palette import find_style
    from pipelines.labels.by_frame import chosen_round
    from pipelines.labels.of_one_frame import (
        decided_in_frame,
        find_frame,
        weighted_frame_names,
    )
    from pipelines.reports.pictures import draw_view

    colours, kind = find_style(style), _image_format(image_format, output)
    opened = open_workspace(workspace)
    if bool(frames) == every:
        raise ConfigError("give the ids of the frames to draw, or --all")
    number = chosen_round(opened, round_number)
    method = policy or opened.config.run.method
    if frames:
        names = list(dict.fromkeys(find_frame(opened, name) for name in frames))
    else:
        names = weighted_frame_names(opened, number, method, limit)
    if output is not None and (recording is not None or len(names) > 1):
        raise ConfigError("--output is for the image of one frame; leave it out")
    if recording is not None:
        from pipelines.reports.recording import record_frames

        path = record_frames(opened, names, number, method, recording)
        paths, found = [path], {"recording": str(path), "frames": len(names)}
    else:
        paths = [
            draw_view(opened, name, number, method, output, kind=kind, style=colours)
            for name in names
        ]
        found = {"picture": str(paths[0])} if len(paths) == 1 else {"pictures": paths}
    decided = {name: decided_in_frame(opened, name, number).by_k for name in names}
    if as_json:
        found["decisions"] = [
            {"frame": name, "k": k, "decision": decision}
            for name, by_k in decided.items()
            for k, decision in sorted(by_k.items())
        ]
        print_json(found)
        return
    for path in paths:
        typer.echo(f"{'recording' if recording else 'picture'}: {path}")
    for name, by_k in decided.items():
        if by_k:
            listed = ", ".join(f"k{k} {decision}" for k, decision in sorted(by_k.items()))
            print_line(f"frame {name}: decisions of people: {listed}", indent=4)


def _image_format(name: str | None, output: Path | None) -> "ImageFormat":
    """Return the image format.

    Raises:
        ConfigError: if it is unknown, or contradicts the suffix of the file.
    """
    from curate.errors import ConfigError
    from curate.viewing.chart_style import check_format

    suffix = output.suffix[1:].lower() if output else ""
    kind = check_format(name or suffix or "png")
    if suffix and suffix != kind:
        raise ConfigError(f"--output {output}: the suffix of a {kind} file is .{kind}")
    return kind
