"""The weights of the method `truth`."""

import numpy as np
import pytest
from support.pipelines_cli import Curate

from curate.errors import ConfigError
from curate.geometry.overlap import bev_iou
from curate.weighting.base import Age
from pipelines.bench.truth import TrueWeights
from pipelines.labels.evidence import read_evidence
from pipelines.workspace.workspace import Workspace, read_truth


def test_correct_labels_of_simulated_frames_have_weight_1(
    curate: Curate, workspace: Workspace
) -> None:
    """The toy detector finds every object once, some of them badly; by the nearest object."""
    assert curate("predict", "-w", workspace.root)[0] == 0
    frames = workspace.frames("unlabeled")
    _, evidence = read_evidence(workspace, 1, list(frames.values()))
    policy = TrueWeights(str(workspace.root))
    with pytest.raises(ConfigError, match="the method truth needs simulated data"):
        policy.weigh(evidence, Age(1, 3))
    (workspace.config.dataset.root / "simulation.json").write_text("{}")
    v = policy.weigh(evidence, Age(1, 3)).v
    expected = []
    names = {key: name for name, key in frames.items()}
    for key, labels in workspace.predictions(1, list(frames.values())).items():
        truth = read_truth(workspace.config, workspace.dataset, names[key])
        same = labels.categories[:, None] == truth.categories[None]
        overlap = np.where(same, np.nan_to_num(bev_iou(labels.boxes, truth.boxes)), 0)
        expected += list(overlap.max(axis=1) > np.where(labels.categories == "Car", 0.7, 0.5))
    assert v.tolist() == [float(each) for each in expected]
    assert 0 < v.sum() < len(v)
