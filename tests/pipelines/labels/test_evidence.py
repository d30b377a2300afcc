"""The evidence of a round, read from the database in columns."""

import numpy as np
import pytest
from support.rounds import run_stage

from pipelines.labels import evidence
from pipelines.workspace.workspace import Workspace

ENGINES = ("sqlite", "postgresql")


def test_evidence_of_many_frames_is_read_alike(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever reads the columns, they are the same to the bit."""
    for name in ("predict", "repredict", "points", "semantic"):
        run_stage(workspace, name)
    frames = list(workspace.frames("unlabeled").values())
    keys, alone = evidence.read_evidence(workspace, 1, frames, boxes=True)
    assert len(keys) > 0
    monkeypatch.setattr(evidence, "MANY_FRAMES", 1)
    same, together = evidence.read_evidence(workspace, 1, frames, boxes=True)
    for one, other in ((keys, same), (alone, together)):
        for name, value in vars(one).items():
            np.testing.assert_equal(vars(other)[name], value, err_msg=name)
