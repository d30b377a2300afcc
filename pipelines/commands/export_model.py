"""curate export-model: write the detector's network as an ONNX model."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, WorkspaceOption, open_workspace
from pipelines.reports.terminal import print_json, print_line


def export_model(
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="File to write; default: exports/ and the name of the checkpoint, with .onnx."
        ),
    ] = None,
    checkpoint: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Checkpoint to export; default: the newest one of the workspace."),
    ] = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write the detector's network as an ONNX model, to run elsewhere; see docs/detectors.md.

    PointPillar takes the points of a sweep and returns boxes, which --detector onnx reads. pillars
    takes pillars and returns maps. Detectors with sparse convolutions cannot be exported.

    Example: curate export-model --output pointpillar.onnx
    """
    from pipelines.stages.export_model import export_onnx

    found = export_onnx(open_workspace(workspace), checkpoint, output)
    if as_json:
        print_json(found)
        return
    print_line(f"{found.output}, from {found.checkpoint}")
    for line in found.usage:
        print_line(line, indent=2)
