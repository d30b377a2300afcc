"""All rounds, stage after stage."""

from collections.abc import Iterator

from pipelines.assembly import open_policy, open_segmenter
from pipelines.engine.progress import Progress
from pipelines.engine.rounds import is_student_trained, is_trainable, open_round
from pipelines.engine.runner import Report, open_executor, run_frames, run_round
from pipelines.engine.stage import FrameStage
from pipelines.registry import PRIORS
from pipelines.round import active
from pipelines.stages.pretrain import pretrain
from pipelines.workspace.workspace import Workspace


def run_all(
    workspace: Workspace,
    rounds: int | None,
    progress: Progress,
    *,
    train: bool = True,
    evidence: bool = True,
) -> Iterator[Report]:
    """Brings every stage of every round up to date, and says what each did as it ends.

    A detector that the user brings is trained only by the user's own command (`train.command`);
    without it, it has one round, without train-round.

    Args:
        workspace: see `Workspace`.
        rounds: E; None for the configured number.
        progress: see `Progress`.
        train: whether students are trained; without them only the first round can be run.
        evidence: whether frames are predicted and scored; false only for a policy that uses no
            unlabeled frames.
    """
    trained = train and is_student_trained(workspace)
    policy = workspace.config.run.method
    # What is wrong with these is better known before hours of work.
    open_policy(workspace.config, policy)
    if evidence and any(PRIORS.takes(name, "segmenter") for name in workspace.config.run.priors):
        open_segmenter(workspace.config)
    if is_trainable(workspace):
        yield pretrain(workspace, progress)
    total = (rounds or workspace.config.run.rounds) if trained else 1
    with open_executor(workspace) as executor:
        for number in range(1, total + 1):
            context = open_round(workspace, number, rounds)
            for stage in active(workspace.config.run.priors):
                if isinstance(stage, FrameStage):
                    if evidence:
                        yield run_frames(workspace, context, stage, executor, progress)
                elif trained or stage.name != "train-round":
                    yield run_round(workspace, context, stage, policy, progress)
