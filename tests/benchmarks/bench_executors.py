"""Executors and workers: predict with curate's own network, in frames per second."""

import shutil
import time

import pytest
from benchmarks.measuring import measure
from support.silent import Silent

from curate.detections import CATEGORIES
from curate.simulation import simulate
from pipelines.engine.runner import open_executor, run_frames
from pipelines.round import open_plan
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

pytestmark = pytest.mark.benchmark(timer=time.perf_counter)

FRAMES = 48
ROUNDS = 3
GROUP = f"Predict for {FRAMES - 1} simulated frames by the clock, workers with their models loaded"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """Return a function that creates a workspace with an untrained network."""
    import torch

    from curate.detectors.pillars.checkpoint import save_checkpoint
    from curate.detectors.pillars.network import PillarNetwork, checkpoint_of
    from curate.detectors.pillars.presets import PRESETS

    home = tmp_path_factory.mktemp("executors")
    simulate(home / "data", FRAMES, 0, val_frames=0, workers=1)
    torch.manual_seed(0)
    network = PillarNetwork(PRESETS["small"], len(CATEGORIES)).eval()
    save_checkpoint(home / "small.safetensors", checkpoint_of(network, CATEGORIES))
    document = {
        "dataset": {"root": home / "data"},
        "detector": {
            "name": "curate.detectors.pillars:PillarDetector",
            "path": home / "small.safetensors",
        },
    }
    workspace = initialise(home / "work", make_config(document, "benchmark"), str(1 / FRAMES), "")
    workspace.database.close()

    def copy():
        place = home / f"copy-{len(list(home.iterdir()))}"
        shutil.copytree(home / "work", place)
        return Workspace.open(place)

    return copy


@pytest.mark.parametrize(
    ("executor", "workers"), [("serial", 1), ("process", 1), ("process", 2), ("ray", 1), ("ray", 2)]
)
def bench_predict(benchmark, prepared, executor, workers):
    """Plan, run and store as `curate predict` does."""
    if executor == "ray":
        pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'")
    settings = {"executor": executor, "workers": workers}
    with open_executor(prepared().with_settings("run", **settings)) as work:

        def predict(workspace):
            plan = open_plan(workspace, 1)
            report = run_frames(plan, plan.graph.frames_stage("predict"), work, Silent())
            assert report.done + report.empty == FRAMES - 1, report.errors

        predict(prepared())  # starts the workers, which load their models
        measure(
            benchmark,
            predict,
            group=GROUP,
            name=f"{executor}, {workers} worker{'s' * (workers > 1)}",
            amount=FRAMES - 1,
            unit="frames",
            setup=lambda: ((prepared(),), {}),
            rounds=ROUNDS,
            figure="rate",
        )
