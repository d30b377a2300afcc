"""curate export: labels as files."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, PolicyOption, WorkspaceOption, open_workspace
from pipelines.commands.stages import run_round_command


def export(
    file_format: Annotated[
        str,
        typer.Option(
            "--format",
            help="sqlite, parquet, csv, coco, kitti, openpcdet, st3d, mmdet3d, nuscenes or "
            "module:Class.",
        ),
    ] = "sqlite",
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="File or folder to write; default: in exports/ of the workspace."),
    ] = None,
    policy: PolicyOption = None,
    round_number: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option("--round", min=1, help="Round; default: the last that the policy weighted."),
    ] = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write the weighted labels in the format of a trainer; docs/training.md tells them apart.

    Example: curate export --format sqlite
    """
    from pipelines.engine.rounds import open_round
    from pipelines.labels.by_frame import weighted_round
    from pipelines.registry import EXPORTERS
    from pipelines.stages.export import export_as

    opened = open_workspace(workspace)
    chosen = policy or opened.config.run.method
    number = round_number or weighted_round(opened, chosen)
    if file_format == "sqlite" and output is None:
        run_round_command("export", opened, number, policy, as_json=as_json)
        return
    exporter = EXPORTERS.build(file_format, offered={}, options={})
    path = output or opened.root / "exports" / f"{exporter.name}{exporter.suffix}"
    context = open_round(opened, number)
    labels = export_as(opened, exporter, context.number, chosen, path)
    typer.echo(f"{labels} labels of round {context.number} in {path}")


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(export)
