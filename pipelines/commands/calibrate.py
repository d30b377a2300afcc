"""curate calibrate: learn the probability that a label is correct."""

from pipelines.commands.options import (
    DryRunOption,
    ExecutorOption,
    JsonOption,
    PolicyOption,
    RoundOption,
    WorkersOption,
    WorkspaceOption,
    open_workspace,
)
from pipelines.commands.stages import run_round_command

LEARNED = "learned"


def calibrate(
    policy: PolicyOption = None,
    round_number: RoundOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    dry_run: DryRunOption = False,
    as_json: JsonOption = False,
) -> None:
    """Learn the probability that a label is correct, for policies such as learned.

    It is learned from frames with ground truth that the teacher has not been trained on. Their
    labels and evidence are made first. Without --policy it is for run.method, or for learned if
    that method reads no probability.

    Example: curate calibrate
    """
    from pipelines.stages.calibrate import applies

    opened = open_workspace(workspace, executor, workers)
    if policy is None and not applies(opened, opened.config.run.method):
        policy = LEARNED
    run_round_command("calibrate", opened, round_number, policy, as_json=as_json, dry_run=dry_run)
