"""The stages of a round in frames per second on one core, without the time of the networks."""

import numpy as np
import pytest
from benchmarks.measuring import cpu_seconds, measure
from benchmarks.scenes import guesses_around

from curate.detectors.pillars.encoding import encode_points
from curate.detectors.pillars.presets import PRESETS
from curate.simulation import simulate
from curate.weighting.base import Age, Evidence
from curate.weighting.self_paced import PSPSL
from pipelines.engine.executors.base import FrameJob
from pipelines.engine.stage import RoundContext, Teacher
from pipelines.labels.sources import source_of
from pipelines.stages import predict, repredict, score
from pipelines.stages.copies import augmented_views
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise

pytestmark = pytest.mark.benchmark(timer=cpu_seconds)

GROUP = "Stages on simulated frames, one core, 60 boxes or more per frame"
FRAMES = 4
CLUTTER = 55


class KnownAnswers:
    """A detector that takes no time: it returns given boxes for each frame."""

    def __init__(self, answers):
        self.answers = answers

    def predict(self, frame):
        """Return the frame's boxes."""
        return self.answers[frame.frame_id]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """Return a workspace on simulated frames, one of them labeled."""
    root = tmp_path_factory.mktemp("simulated")
    simulate(root / "data", FRAMES, 0, val_frames=0, workers=1)
    document = {
        "dataset": {"root": root / "data"},
        "segmenter": {
            "name": "saved",
            "path": root / "data" / "training" / "semantic_2",
            "classes": "simulated",
        },
    }
    return initialise(root / "work", make_config(document, "benchmark"), str(1 / FRAMES), "")


@pytest.fixture(scope="module")
def context(workspace):
    """Return the first round."""
    return RoundContext(1, 3, 0, Teacher(workspace.root / "none", ""))


@pytest.fixture(scope="module")
def guesses(workspace):
    """Return predictions by frame id."""
    generator = np.random.default_rng(0)
    return {
        name: guesses_around(generator, workspace.dataset.annotations(name), CLUTTER)
        for name in workspace.dataset.frame_ids()
    }


def of_frames(benchmark, names, function, name):
    """Measure a function on every frame."""
    return measure(
        benchmark,
        lambda: [function(frame) for frame in names],
        group=GROUP,
        name=name,
        amount=len(names),
        unit="frames",
        figure="rate",
    )


def of_jobs(benchmark, guesses, stage, name):
    """Measure a stage with the predictions of every frame; return the rows of the first."""
    jobs = {frame: FrameJob(0, frame, found) for frame, found in guesses.items()}
    rows = of_frames(benchmark, list(jobs), lambda frame: stage(jobs[frame]), name)
    return rows[0]


def bench_simulate(benchmark, tmp_path):
    """Simulate sweep, image, semantic map and labels of a frame."""
    count = 3

    def setup() -> tuple[tuple, dict]:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        return (folder, count, 1), {"val_frames": 0, "workers": 1}

    measure(
        benchmark,
        simulate,
        group=GROUP,
        name="simulate",
        amount=count,
        unit="frames",
        setup=setup,
        rounds=2,
        figure="rate",
    )


def bench_read(benchmark, workspace):
    """Read points, calibration and the size of the image."""
    frames = of_frames(
        benchmark, workspace.dataset.frame_ids(), workspace.dataset.read, "read: sweep, calibration"
    )
    assert len(frames[0].points) > 10_000


def bench_read_image(benchmark, workspace):
    """Read the image as well."""
    of_frames(
        benchmark,
        workspace.dataset.frame_ids(),
        lambda name: workspace.dataset.read(name, image=True),
        "read: sweep, calibration, image",
    )


def bench_predict(benchmark, workspace):
    """Run everything before the network: read, crop to the camera's view, build pillars."""

    def prepare(name):
        frame = predict.visible(workspace.dataset.read(name), workspace.config)
        return encode_points(frame.points, PRESETS["small"])

    pillars = of_frames(
        benchmark, workspace.dataset.frame_ids(), prepare, "predict, up to the network"
    )
    assert len(pillars[0].slots) > 1000


def bench_repredict(benchmark, workspace, context, guesses):
    """Read, crop, augment, map the boxes back, match, compute the consistency loss."""
    drawn = augmented_views(workspace.config, context.seed, context.number)
    answers = {}
    for name, found in guesses.items():
        [similarity] = drawn.draw(name)
        boxes = similarity.apply_to_boxes(found.boxes)
        answers[name] = type(found)(boxes, found.scores, found.categories)
    stage = repredict.function(workspace, context)
    stage.dataset, stage.detector = workspace.dataset, KnownAnswers(answers)
    name = "repredict, without the network"
    rows = of_jobs(benchmark, guesses, lambda job: stage.batch([job])[0], name)
    assert all(rows["consistency"]["matched_views"])


def bench_points(benchmark, workspace, context, guesses):
    """Read, and count the points in the boxes."""
    stage = score.stage(source_of("points")).function(workspace, context)
    stage.open()
    rows = of_jobs(benchmark, guesses, stage, "score --prior points")
    assert len(rows["point_prior"]["k"]) > CLUTTER


def bench_semantic(benchmark, workspace, context, guesses):
    """Read the frame and its saved semantic map, and count the pixels in the boxes."""
    stage = score.stage(source_of("semantic")).function(workspace, context)
    stage.open()
    rows = of_jobs(benchmark, guesses, stage, "score --prior semantic, saved maps")
    assert len(rows["semantic_prior"]["k"]) > CLUTTER


def bench_semantic_with_stored_maps(benchmark, workspace, context, guesses):
    """The same with the maps of the simulated segmenter, which `segment` has stored."""
    simulated = workspace.with_settings("segmenter", name="simulated", path=None, classes=None)
    stage = score.stage(source_of("semantic")).function(simulated, context)
    stage.open()
    for frame, found in guesses.items():
        stage(FrameJob(0, frame, found))
    rows = of_jobs(benchmark, guesses, stage, "score --prior semantic, stored maps")
    assert len(rows["semantic_prior"]["k"]) > CLUTTER


def bench_solve(benchmark):
    """Solve the closed form over a million labels of 20,000 frames, in memory."""
    generator = np.random.default_rng(0)
    count = 1_000_000
    evidence = Evidence(
        frame_index=np.repeat(np.arange(count // 50), 50),
        category=generator.choice(["Car", "Pedestrian", "Cyclist"], count),
        score=generator.random(count),
        loss=np.where(generator.random(count) < 0.1, np.nan, generator.exponential(1, count)),
        rho={"rho_diff": generator.random(count), "rho_anno": generator.random(count)},
    )
    weights = measure(
        benchmark,
        lambda: PSPSL().weigh(evidence, Age(1, 3)),
        group=GROUP,
        name="solve in memory, 1,000,000 labels",
        amount=count,
        unit="labels",
        figure="rate",
    )
    assert 0 < weights.v.mean() < 1
