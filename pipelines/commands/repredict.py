"""curate repredict: run the teacher on augmented copies of frames."""

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


def repredict(
    split: SplitOption = "unlabeled",
    round_number: RoundOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run the teacher on augmented copies of frames and compute the consistency loss.

    With repredict.fuse = true, it also fuses the boxes of the labels.

    Example: curate repredict
    """
    run_frame_command(
        ("repredict",), workspace, round_number, split, executor, workers,
        as_json=as_json, dry_run=dry_run,
    )  # fmt: skip
