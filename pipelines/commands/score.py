"""curate score: compute the priors of predictions."""

from typing import Annotated, Optional

import typer

from pipelines.commands.options import (
    DryRunOption,
    ExecutorOption,
    JsonOption,
    RoundOption,
    SplitOption,
    WorkersOption,
    WorkspaceOption,
    complete,
    registered,
)
from pipelines.commands.stages import run_frame_command
from pipelines.registry import PRIORS


def score(
    prior: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help=f"One prior only: {registered(PRIORS)}; default: run.priors of curate.toml.",
            autocompletion=complete(PRIORS.classes),
        ),
    ] = None,
    split: SplitOption = "unlabeled",
    round_number: RoundOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compute the priors of each box, such as its LiDAR points and its segmentation pixels.

    The point prior is Eq. 8 of the paper, the semantic prior Eq. 9.

    Example: curate score --prior points
    """
    stages = None if prior is None else (prior,)
    run_frame_command(
        stages, workspace, round_number, split, executor, workers,
        as_json=as_json, dry_run=dry_run,
    )  # fmt: skip
