"""The cost of a frame without the networks: read, augment, match, priors, solve, write."""

import os
import shutil

import numpy as np
import pytest
from benchmarks.measuring import cpu_seconds, measure
from benchmarks.scenes import SIDES, sweep
from support import rounds

from curate.datasets.kitti.calibration import write_calibration
from curate.datasets.kitti.labels import from_annotations, write_objects
from curate.detections import CATEGORIES, Annotations, Detections, as_categories
from curate.frames import Calibration
from curate.segmenters.base import SemanticMap
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

pytestmark = pytest.mark.benchmark(timer=cpu_seconds)

POINTS, LABELS = 120_000, 20
# One labeled frame and eight times as many others as the runner stores at once, so that
# start-up costs hardly count; they are links to a few files.
FRAMES, TEMPLATES = 513, 8
IMAGE_SIZE = (1242, 375)
TARGET_S = 15e-3
ROUNDS = 3
GROUP = f"A frame of {POINTS:,} points and {LABELS} labels beside the networks, one core"
STAGES = ("predict", "repredict", "points", "semantic", "solve")


class Answers:
    """A detector without a network: it returns given boxes, for the augmented copy as well."""

    def __init__(self, path):
        self.boxes = np.load(path)
        self.drawn = np.random.default_rng(0)

    def predict(self, frame):
        """Return the frame's boxes with a small offset."""
        boxes = self.boxes + self.drawn.normal(0, 0.02, self.boxes.shape)
        names = [CATEGORIES[i % len(CATEGORIES)] for i in range(len(boxes))]
        return Detections(boxes, np.linspace(0.9, 0.2, len(boxes)), as_categories(names))


class KnownMap:
    """A segmenter without a network."""

    needs_image = needs_points = False

    def __init__(self, path):
        classes = np.arange(IMAGE_SIZE[0] * IMAGE_SIZE[1]).reshape(IMAGE_SIZE[::-1]) // 97 % 4
        class_ids = {name: (i + 1,) for i, name in enumerate(CATEGORIES)}
        self.answer = SemanticMap(classes.astype(np.uint8), class_ids)

    def segment(self, frame):
        """Return the same map for every frame."""
        return self.answer


@pytest.fixture(scope="module")
def configuration(tmp_path_factory):
    """Return settings of a workspace on frames in KITTI's layout.

    The boxes are in front of the camera.
    """
    root = tmp_path_factory.mktemp("frames")
    generator = np.random.default_rng(0)
    kinds = np.arange(LABELS) % len(CATEGORIES)
    places = generator.uniform([8, -8, -1.2], [50, 8, -0.6], (LABELS, 3))
    boxes = np.column_stack([places, SIDES[kinds], generator.uniform(-3, 3, LABELS)])
    np.save(root / "boxes.npy", boxes)
    home = root / "training"
    for folder in ("velodyne", "image_2", "calib", "label_2"):
        (home / folder).mkdir(parents=True)
    for i in range(TEMPLATES):
        write_frame(home, f"{i:06d}", generator, boxes)
    for i in range(TEMPLATES, FRAMES):
        for folder, suffix in (("velodyne", "bin"), ("image_2", "png"), ("calib", "txt")):
            template = home / folder / f"{i % TEMPLATES:06d}.{suffix}"
            os.link(template, template.with_stem(f"{i:06d}"))
    document = {
        "dataset": {"root": root},
        "detector": {"name": "benchmarks.bench_overhead:Answers", "path": root / "boxes.npy"},
        "segmenter": {"name": "benchmarks.bench_overhead:KnownMap", "path": root / "boxes.npy"},
        "repredict": {"flip_probability": 0.0, "rotation_limit_rad": 0.0, "scale_range": (1, 1)},
    }
    return make_config(document, "benchmark")


def write_frame(home, name, generator, boxes):
    """Write one frame; the first one has labels."""
    import cv2

    projection = np.array([[721.5, 0, 609.6, 44.9], [0, 721.5, 172.9, 0.2], [0, 0, 1, 0.003]])
    to_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.3], [0, 0, 0, 1]])
    calibration = Calibration(projection, to_camera)
    sweep(generator, POINTS).tofile(home / "velodyne" / f"{name}.bin")
    image = np.zeros((*IMAGE_SIZE[::-1], 3), np.uint8)
    cv2.imwrite(str(home / "image_2" / f"{name}.png"), image)
    write_calibration(home / "calib" / f"{name}.txt", calibration)
    if name == "000000":
        nothing = np.zeros(len(boxes))
        truth = Annotations(
            boxes=boxes,
            categories=as_categories([CATEGORIES[i % 3] for i in range(len(boxes))]),
            truncated=nothing,
            occluded=nothing.astype(np.int64),
            alpha=nothing,
            boxes_2d=np.tile([0.0, 0, 100, 39], (len(boxes), 1)),
        )
        write_objects(home / "label_2" / f"{name}.txt", from_annotations(truth, calibration))


def run_stage(workspace, name):
    """Bring a stage up to date for all frames."""
    report = rounds.run_stage(workspace, name)
    if name == "solve":
        return report
    assert (report.failed, report.done) == (0, FRAMES - 1), report.errors
    return report


@pytest.fixture(scope="module")
def prepared(configuration, tmp_path_factory):
    """Return a function that creates a workspace with all stages before one up to date."""
    home = tmp_path_factory.mktemp("prepared")
    workspace = initialise(home / "work", configuration, str(1 / FRAMES), "")
    for name in STAGES:
        workspace.database.close()
        shutil.copytree(workspace.root, home / name)
        run_stage(workspace, name)

    def copy(name):
        place = home / f"copy-{len(list(home.iterdir()))}"
        shutil.copytree(home / name, place)
        return Workspace.open(place)

    return copy


@pytest.mark.parametrize("name", STAGES)
def bench_stage(benchmark, name, prepared):
    """Plan, run and store one stage as a command does."""
    measure(
        benchmark,
        run_stage,
        group=GROUP,
        name=name,
        amount=FRAMES - 1,
        unit="frames",
        setup=lambda: ((prepared(name), name), {}),
        rounds=ROUNDS,
        figure="rate",
    )


def bench_round(benchmark, prepared):
    """Run all stages, against the target per frame."""

    def whole(workspace):
        for name in STAGES:
            run_stage(workspace, name)

    measure(
        benchmark,
        whole,
        group=GROUP,
        name=f"all stages of {FRAMES - 1} frames",
        amount=FRAMES - 1,
        unit="frames",
        setup=lambda: ((prepared(STAGES[0]),), {}),
        rounds=ROUNDS,
        target_s=TARGET_S * (FRAMES - 1),
        figure="rate",
    )
