"""curate export: write weighted labels to files."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.dry_run import print_preview
from pipelines.commands.options import (
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
from pipelines.reports.terminal import print_missing


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
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Fail, and write nothing, if a failed frame is missing."),
    ] = False,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the weighted labels as files in the format of a trainer; see docs/training.md.

    A file in the folder exports has its round and policy in its name: round-01-pspsl.csv. Frames
    that failed are not in the export; a line lists them.

    Example: curate export --format sqlite
    """
    from curate.errors import FramesFailed
    from curate.exporters.base import named
    from pipelines.engine.preview import PlannedStage
    from pipelines.engine.rounds import open_round, preview_round
    from pipelines.engine.runner import Report
    from pipelines.labels.by_frame import weighted_round
    from pipelines.stages.export import default_path, export_as, missing_frames

    opened = open_workspace(workspace)
    chosen = policy or opened.config.run.method
    number = round_number or weighted_round(opened, chosen)
    missing = () if number is None else missing_frames(opened, number, chosen)
    if strict and missing:
        raise FramesFailed(
            f"--strict: failed frames of round {number} that would be missing: {len(missing)} "
            f"({named(missing)}); see `curate status --failed`, fix the files and run `curate run`"
        )
    if file_format == "sqlite" and output is None:
        run_round_command(
            "export", opened, number, policy, as_json=as_json, dry_run=dry_run, missing=missing
        )
        return
    exporter = EXPORTERS.build(file_format, offered={}, options={})
    if dry_run:
        number = preview_round(opened, number).number
        path = output or default_path(opened, number, chosen, exporter)
        why = (f"{path} would be written; this format is always exported again",)
        print_preview([PlannedStage(number, "export", None, (), why, None)], as_json=as_json)
        return
    start = time.perf_counter()
    context = open_round(opened, number)
    path = output or default_path(opened, context.number, chosen, exporter)
    labels = export_as(opened, exporter, context.number, chosen, path)
    summary = f"{labels} labels of round {context.number} in {path}"
    seconds = time.perf_counter() - start
    report = Report("export", context.number, 1, labels=labels, seconds=seconds, summary=summary)
    report = replace(report, missing=missing)
    if not as_json:
        typer.echo(summary)
        print_missing(missing)
    end([report], as_json=as_json)
