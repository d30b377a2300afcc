"""curate suspects: list labels that held-out teachers, points or pixels contradict."""

from pathlib import Path
from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    ExecutorOption,
    JsonOption,
    ProcessesOption,
    RoundOption,
    ThreadsOption,
    WorkersOption,
    WorkspaceOption,
    end,
    open_workspace,
)
from pipelines.reports.terminal import print_json, print_line, print_report, print_table


def suspects(
    split: Annotated[str, typer.Option(help="Labels to check: labeled, val or all.")] = "all",
    folds: Annotated[
        int,
        typer.Option(
            min=1,
            help="Number of held-out folds of the labeled frames, for a detector that curate "
            "trains.",
        ),
    ] = 5,
    limit: Annotated[int, typer.Option(min=1, help="At most this many suspects.")] = 50,
    minimum: Annotated[float, typer.Option(help="Lowest suspicion to list, 0 to 1.")] = 0.7,
    pictures: Annotated[
        bool,
        typer.Option("--pictures", help="Draw a close-up of each suspect into pictures/suspects/."),
    ] = False,
    output: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="CSV file to write, with a column for decisions."),
    ] = None,
    round_number: RoundOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    processes: ProcessesOption = None,
    threads: ThreadsOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """List labels of X_l and val that are probably missing, misplaced or misnamed, with reasons.

    The labels are compared with the predictions of teachers that were not trained on them, and with
    their LiDAR points and pixels. The labeled frames are predicted by K teachers, each trained
    without one fold, as in `curate audit --folds K`, which takes K trainings; val by the teacher of
    the round. A detector that curate does not train predicts both. Suspicion is the share of
    comparable labels or predictions in which nothing is wrong: a rank, not a probability.

    Example: curate suspects --split val --pictures --output suspects.csv
    """
    from curate.errors import ConfigError
    from pipelines.assessment.suspects import (
        SPLITS,
        SuspectRequest,
        draw_suspects,
        run_suspects,
        suspect_rows,
        write_table,
    )
    from pipelines.category_names import check_names
    from pipelines.engine.progress import Bar

    if output is not None and (output.is_dir() or not output.resolve().parent.is_dir()):
        raise ConfigError(f"--output {output}: must be a file in an existing folder")
    splits = SPLITS if split == "all" else (split,)
    request = SuspectRequest(splits, folds, round_number, minimum)
    opened = open_workspace(workspace, executor, workers, threads, processes)
    check_names(opened)
    found = run_suspects(opened, request, Bar(), (lambda _: None) if as_json else print_report)
    rows = suspect_rows(opened, found)[:limit]
    folder = draw_suspects(opened, found, rows, Bar()) if pictures else None
    if output is not None:
        write_table(output, rows)
    if as_json:
        print_json(
            {
                "labels": found.labels,
                "frames": len(found.frames),
                "teachers": found.teachers,
                "found": len(found.suspects),
                "suspects": rows,
            }
        )
    else:
        names = ("rank", "split", "frame", "k", "category", "suspicion", "reason")
        title = (
            f"{len(rows)} of {len(found.suspects)} suspects among {found.labels} labels of "
            f"{len(found.frames)} frames; {found.teachers}"
        )
        table = [
            tuple(row[name] if row[name] is not None else "new" for name in names) for row in rows
        ]
        print_table(names, table, title=title)
        if folder is not None:
            print_line(f"pictures: {folder}")
        if output is not None:
            print_line(f"table: {output}")
    end(found.reports, as_json=False)
