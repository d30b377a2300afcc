"""curate export: write weighted labels to files."""

import time
from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.dry_run import print_preview
from pipelines.commands.options import (
    AllowEmptyOption,
    DryRunOption,
    JsonOption,
    LastRoundOption,
    PolicyOption,
    WorkspaceOption,
    complete,
    end,
    open_workspace,
    registered,
)
from pipelines.commands.stages import run_round_command
from pipelines.registry import EXPORTERS


def export(
    file_format: Annotated[
        str,
        typer.Option(
            "--format",
            help=f"File format: {registered(EXPORTERS)}.",
            autocompletion=complete(EXPORTERS.classes),
        ),
    ] = "sqlite",
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="File or folder to write; default: in the folder exports of the workspace."
        ),
    ] = None,
    policy: PolicyOption = None,
    round_number: LastRoundOption = None,
    workspace: WorkspaceOption = None,
    allow_empty: AllowEmptyOption = False,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the weighted labels as files in the format of a trainer; see docs/training.md.

    Example: curate export --format sqlite
    """
    from pipelines.engine.preview import PlannedStage
    from pipelines.engine.rounds import open_round, preview_round
    from pipelines.engine.runner import Report
    from pipelines.labels.by_frame import weighted_round
    from pipelines.stages.export import export_as

    opened = open_workspace(workspace, allow_empty=allow_empty)
    chosen = policy or opened.config.run.method
    number = round_number or weighted_round(opened, chosen)
    if file_format == "sqlite" and output is None:
        run_round_command("export", opened, number, policy, as_json=as_json, dry_run=dry_run)
        return
    exporter = EXPORTERS.build(file_format, offered={}, options={})
    path = output or opened.root / "exports" / f"{exporter.name}{exporter.suffix}"
    if dry_run:
        number = preview_round(opened, number).number
        why = (f"{path} would be written; this format is always exported again",)
        print_preview([PlannedStage(number, "export", None, (), why, None)], as_json=as_json)
        return
    start = time.perf_counter()
    context = open_round(opened, number)
    labels = export_as(opened, exporter, context.number, chosen, path)
    summary = f"{labels} labels of round {context.number} in {path}"
    seconds = time.perf_counter() - start
    report = Report("export", context.number, 1, labels=labels, seconds=seconds, summary=summary)
    if not as_json:
        typer.echo(summary)
    end([report], as_json=as_json)
