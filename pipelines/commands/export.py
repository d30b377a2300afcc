"""curate export: labels as files."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, PolicyOption, RoundOption, WorkspaceOption
from pipelines.commands.stages import run_round_command


def export(
    file_format: Annotated[str, typer.Option("--format", help="sqlite or kitti.")] = "sqlite",
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder for --format kitti; default: exports/kitti of the workspace."),
    ] = None,
    policy: PolicyOption = None,
    round_number: RoundOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Write the weighted labels: one SQLite file, or KITTI label files.

    Example: curate export --format sqlite
    """
    from curate.errors import ConfigError

    if file_format == "sqlite" and output is None:
        run_round_command("export", workspace, round_number, policy, as_json=as_json)
    elif file_format == "kitti":
        from pipelines.commands.options import open_workspace
        from pipelines.rounds import open_round
        from pipelines.stages.export import export_kitti_files

        opened = open_workspace(workspace)
        context = open_round(opened, round_number)
        chosen = policy or opened.config.run.method
        folder = output or opened.root / "exports" / "kitti"
        labels = export_kitti_files(opened, context.number, chosen, folder)
        typer.echo(f"{labels} labels in {folder}")
    else:
        raise ConfigError(f"--format {file_format}: use sqlite (without --output) or kitti")


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command()(export)
