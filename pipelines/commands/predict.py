"""curate predict: run the teacher on frames."""

from pipelines.commands.options import (
    DryRunOption,
    ExecutorOption,
    JsonOption,
    RoundOption,
    SplitOption,
    WorkersOption,
    WorkspaceOption,
)
from pipelines.commands.stages import run_frame_command


def predict(
    split: SplitOption = "unlabeled",
    round_number: RoundOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run the teacher on frames and store its predictions, including low scores.

    Example: curate predict --split unlabeled
    """
    run_frame_command(
        ("predict",), workspace, round_number, split, executor, workers,
        as_json=as_json, dry_run=dry_run,
    )  # fmt: skip
