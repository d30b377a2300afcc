"""The method `truth`: weight 1 for correct labels, the most that weights alone can reach.

It reads the label files of X_u, which only the bench may do, and only if it simulated them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Final

import numpy as np

from curate.errors import ConfigError
from curate.weighting.base import Age, Evidence, Policy, Weights
from pipelines.assessment.label_quality import judge_labels
from pipelines.stages.methods import METHODS, Method
from pipelines.workspace.workspace import Workspace

TRUTH = "truth"
BENCH_METHODS: Final = {
    **METHODS,
    TRUTH: Method(
        "pipelines.bench.truth:TrueWeights",
        "student",
        "weight 1 for every correct label, 0 for the others: an upper bound, from the truth",
    ),
}
"""The methods of a bench."""


@dataclass(frozen=True)
class TrueWeights(Policy):
    """v = 1 for a label that is correct in BEV at the configured overlaps, else 0.

    Attributes:
        workspace: folder of the bench's cell.
    """

    name: ClassVar[str] = TRUTH
    reads: ClassVar[tuple[str, ...]] = ()
    workspace: str

    def weigh(self, evidence: Evidence, age: Age) -> Weights:
        """Return the weights; the labels are all those of their frames, in the order of k.

        Raises:
            ConfigError: if the frames are not simulated.
        """
        workspace = Workspace.open(Path(self.workspace))
        if not (workspace.config.dataset.root / "simulation.json").is_file():
            raise ConfigError("the method truth needs simulated data")
        judged = judge_labels(workspace, age.round)
        workspace.database.close()
        _, first, count = np.unique(evidence.frame_index, return_index=True, return_counts=True)
        v = np.zeros(len(evidence))
        for begin, n in zip(first.tolist(), count.tolist(), strict=True):
            frame = int(evidence.frame_index[begin])
            v[begin : begin + n] = [judged.correct.get((frame, k), False) for k in range(n)]
        return Weights.without_age(v)
