"""curate propose: propose objects that have no label, from image masks and LiDAR points."""

from pipelines.commands.options import (
    ExecutorOption,
    JsonOption,
    LastRoundOption,
    PolicyOption,
    SplitOption,
    WorkersOption,
    WorkspaceOption,
    open_workspace,
)
from pipelines.reports.terminal import print_json, print_line


def propose(
    split: SplitOption = "unlabeled",
    round_number: LastRoundOption = None,
    policy: PolicyOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Propose missed objects: image masks without a label, boxed by the LiDAR points behind them.

    A mask is an instance of the segmenter, or else a connected part of its map. In unlabeled
    frames, labels with a weight of at least 0.1 and decisions of people count as labels; in labeled
    and val frames, the ground truth does. Proposals have no weight, are in no export, and train
    nothing. They are stored in the table proposal, for `curate review export --by proposals`.

    Example: curate propose && curate review export to-review --by proposals
    """
    from curate.errors import FramesFailed
    from pipelines.category_names import check_names
    from pipelines.engine.progress import Bar
    from pipelines.stages.propose import propose as propose_objects

    opened = open_workspace(workspace, executor, workers)
    check_names(opened)
    found = propose_objects(opened, split, round_number, policy, Bar())
    if as_json:
        print_json(found)
    else:
        counts = ", ".join(f"{number} {name}" for name, number in found.categories.items())
        where = f"a label of round {found.round}" if found.round else "ground truth"
        print_line(
            f"{counts} proposed in {found.frames} {split} frames, at image masks without {where}"
        )
    if found.failed:
        raise FramesFailed(f"{found.failed} frames failed; fix the files and rerun")
