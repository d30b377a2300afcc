"""The common queries about labels, and a workspace with weighted labels."""

from collections.abc import Sequence

from pipelines.engine.stage import RoundContext, RoundJob, Teacher
from pipelines.stages import solve
from pipelines.workspace.workspace import Workspace
from support.silent import Silent

COUNTS = "SELECT policy, category, labels, trusted FROM label_count WHERE round = 1"
TRUSTED = "SELECT * FROM weighted_labels WHERE round = 1 AND weight > 0.5 AND category = 'Car'"
HEAVIEST = TRUSTED + " AND policy = 'pspsl' ORDER BY weight DESC"
FRAME = "SELECT * FROM weighted_labels WHERE frame = '000007'"
FRAME_OF_ROUND = FRAME + " AND round = 1 AND policy = 'pspsl' ORDER BY k"


def solved(
    workspace: Workspace,
    policy: str = "pspsl",
    rounds: int = 3,
    frames: Sequence[int] | None = None,
) -> Workspace:
    """Return the workspace with the weights of a policy for some or all frames."""
    if frames is None:
        frames = list(workspace.frames("unlabeled").values())
    context = RoundContext(1, rounds, 0, Teacher(workspace.root, ""))
    product = solve.run(workspace, RoundJob(context, policy, frames), Silent())
    with workspace.database.writing(keys_known=product.keys_known) as connection:
        product.write(connection)
    return workspace
