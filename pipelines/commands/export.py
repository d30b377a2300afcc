"""curate export: labels as files."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, PolicyOption, RoundOption, WorkspaceOption
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
    round_number: RoundOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write the weighted labels in the format of a trainer; docs/training.md tells them apart.

    Example: curate export --format sqlite
    """
    if file_format == "sqlite" and output is None:
        run_round_command("export", workspace, round_number, policy, as_json=as_json)
        return
    from pipelines.commands.options import open_workspace
    from pipelines.registry import EXPORTERS
    from pipelines.rounds import open_round
    from pipelines.stages.export import export_as

    exporter = EXPORTERS.build(file_format, offered={}, options={})
    opened = open_workspace(workspace)
    path = output or opened.root / "exports" / f"{exporter.name}{exporter.suffix}"
    context = open_round(opened, round_number)
    chosen = policy or opened.config.run.method
    labels = export_as(opened, exporter, context.number, chosen, path)
    typer.echo(f"{labels} labels in {path}")


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(export)
