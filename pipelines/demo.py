"""The demo: the whole pipeline on simulated data, with an evaluation of its labels and detectors.

The demo may read the ground truth of X_u because it simulated it. It reads the label files at the
end, to evaluate the pseudo-labels, and stores nothing of them.
"""

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import typer

from curate.errors import CurateError, WorkspaceError
from curate.evaluation import kitti_ap
from curate.evaluation.comparison import known_mean
from curate.evaluation.kitti_rules import relaxed
from pipelines.assessment.evaluation import detect_val, val_objects
from pipelines.assessment.label_quality import label_quality
from pipelines.engine.progress import Bar, as_total
from pipelines.engine.rounds import open_round
from pipelines.engine.runner import run_round
from pipelines.engine.schedule import run_all
from pipelines.labels.matching import configured_overlaps
from pipelines.reports.terminal import print_report, print_table
from pipelines.round import graph_of, open_plan
from pipelines.stages import train_round
from pipelines.workspace.config import Config, make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

Say = Callable[[str], None]

LEARNED = "from X_l and the weighted pseudo-labels"
# The demo compares the student of the configured policy with the students of these.
OTHERS = {
    "baseline": "from X_l alone, for the same number of steps",
    "uniform": "from X_l and all pseudo-labels, unweighted",
}
EVALUATED = ("uniform", "threshold", "spsl", "pspsl")
QUERY = (
    "SELECT frame, k, category, score, loss, points, rho_det, weight FROM weighted_labels "
    "WHERE policy = 'pspsl' ORDER BY weight DESC LIMIT 5"
)


@dataclass(frozen=True)
class Demo:
    """What to simulate and how long to train; see `curate demo --help`."""

    directory: Path
    frames: int
    val: int
    labeled: float
    rounds: int
    steps: int
    seed: int
    workers: int | None

    @property
    def data(self) -> Path:
        """The simulated data set."""
        return self.directory / "data"

    @property
    def processes(self) -> int:
        """Number of processes to use."""
        return self.workers or os.cpu_count() or 1

    def config(self) -> Config:
        """Return the settings of the workspace."""
        document = {
            "dataset": {"root": self.data},
            "segmenter": {"name": "simulated"},
            "train": {
                "pretrain_steps": self.steps,
                "round_steps": self.steps,
                "threads": 1,
            },
            "run": {"rounds": self.rounds, "seed": self.seed},
        }
        return make_config(document, "curate demo")


def run_demo(demo: Demo, say: Say) -> None:
    """Simulate, train, weight labels, train students, evaluate and draw; resume after a kill."""
    start = time.perf_counter()
    _simulate(demo, say)
    workspace = initialise(demo.directory, demo.config(), str(demo.labeled), "")
    workspace = workspace.with_settings(
        "run", workers=demo.processes, executor="process" if demo.processes > 1 else "serial"
    ).with_settings("train", processes="auto" if demo.processes > 1 else 1)
    graph = graph_of(workspace)
    counts = [len(workspace.frames(split)) for split in ("labeled", "unlabeled", "val")]
    say("\n2. Train the teacher on few labels, predict on the others, weight the predictions.")
    say(
        "   {} labeled, {} unlabeled, {} val frames. Segmentation: the shipped ONNX".format(*counts)
    )
    say("   model, which was trained on other simulated images.\n")
    for report in run_all(workspace, graph, demo.rounds, Bar(), train=False):
        print_report(report)
    _weight_for_others(workspace)
    say("\n   Query any weight with SQL:\n")
    say(f'   curate query -w {_shown(demo.directory)} "{QUERY}"')
    _print_query(workspace)
    say("3. Train students, starting from the teacher, for the same number of steps.\n")
    _train_students(workspace, demo)
    for report in run_all(workspace, graph, demo.rounds, Bar()):
        if report.done:
            print_report(report)
    for policy, how in {workspace.config.run.method: LEARNED, **OTHERS}.items():
        say(f"   {policy:<9} {how}")
    say("\n4. Evaluate the pseudo-labels against the ground truth of the simulation.\n")
    _print_quality(workspace)
    say("5. Evaluate the detectors on the val frames, which no training used.\n")
    _print_detectors(workspace)
    _draw(workspace, say)
    say(f"\nThe demo took {(time.perf_counter() - start) / 60:.1f} minutes. Next:")
    for command in ("status", "explain FRAME K", "graph", "audit", "evaluate"):
        say(
            f"   curate {command}" + ("" if command == "graph" else f" -w {_shown(demo.directory)}")
        )


def _simulate(demo: Demo, say: Say) -> None:
    from curate.simulation import simulate

    start = time.perf_counter()
    total = demo.frames + demo.val
    say(f"1. Simulate {total} LiDAR-camera frames in KITTI's format.\n")
    with Bar().track("simulate", total) as advance:
        simulate(
            demo.data,
            total,
            demo.seed,
            val_frames=demo.val,
            workers=demo.processes,
            progress=as_total(advance),
        )
    say(f"   {total} frames in {_shown(demo.data)} ({time.perf_counter() - start:.1f} s)")


def _weight_for_others(workspace: Workspace) -> None:
    """Compute and export the weights of other policies, for the first round."""
    plan = open_plan(workspace, 1)
    for name, policies in (("solve", (*EVALUATED, *OTHERS)), ("export", tuple(OTHERS))):
        for policy in dict.fromkeys(policies):
            if policy != workspace.config.run.method:
                run_round(plan, name, policy, Bar())


def _train_students(workspace: Workspace, demo: Demo) -> None:
    """Train one student per process with one thread; the network is too small for more threads."""
    policies = (workspace.config.run.method, *OTHERS)
    with ThreadPoolExecutor(len(policies) if demo.processes > 1 else 1) as pool:
        list(pool.map(lambda policy: _train_student(workspace, policy), policies))


def _train_student(workspace: Workspace, policy: str) -> None:
    command = [
        *(sys.executable, "-m", "curate_command", "train-round"),
        *("--round", "1", "--policy", policy),
        *("--workspace", str(workspace.root)),
    ]
    ended = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)  # noqa: S603
    if ended.returncode:
        raise CurateError(f"training the student of {policy} failed; see the message above")


def _print_query(workspace: Workspace) -> None:
    from pipelines.queries.run_query import run_query

    columns, rows = run_query(workspace.database.url, QUERY)
    print_table(columns, rows)


def _print_quality(workspace: Workspace) -> None:
    rows = label_quality(workspace, 1, EVALUATED)
    print_table(
        ("policy", "labels", "weight > 0", "weighted precision %", "weighted recall %", "AUROC"),
        rows,
    )


def _print_detectors(workspace: Workspace) -> None:
    rows, left_out = [], set()
    overlaps = configured_overlaps(workspace.config)
    loose = relaxed(overlaps)
    for name, path in _detectors(workspace):
        objects = val_objects(workspace, detect_val(workspace, path, Bar()))
        at_kitti, at_loose = (objects.evaluate(each).ap_r40[:, :, 1] for each in (overlaps, loose))
        bev, box = kitti_ap.FIGURES.index("bev"), kitti_ap.FIGURES.index("3d")
        means = (at_loose[:, box], at_loose[:, bev], at_kitti[:, box], at_kitti[:, bev])
        by_category = at_loose[:, box].tolist()
        left_out |= {c for c, ap in zip(overlaps, by_category, strict=True) if math.isnan(ap)}
        rows.append((name, *by_category, *(float(known_mean(mean, 1)) for mean in means)))
    columns = ("detector", *overlaps, "3D mean", "BEV mean", "3D KITTI", "BEV KITTI")
    print_table(columns, rows, title="AP R40, moderate, percent")
    shown = ", ".join(f"{name} {overlap:g}" for name, overlap in loose.items())
    at = ", ".join(f"{overlap:g}" for overlap in overlaps.values())
    typer.echo(f"   IoU thresholds: {shown}; in the columns KITTI: {at}.")
    if left_out:
        typer.echo(f"   Not in the means, because no object counts: {', '.join(sorted(left_out))}.")


def _detectors(workspace: Workspace) -> Sequence[tuple[str, Path | None]]:
    """Return the detectors to compare, with their checkpoints."""
    rounds = workspace.config.run.rounds
    first = open_round(workspace, 1)
    policy = workspace.config.run.method
    students = [
        (f"{policy} student, round {number}", train_round.file(workspace, context, policy))
        for number in range(1, rounds + 1)
        for context in (open_round(workspace, number),)
    ]
    return [
        ("teacher", first.teacher.path),
        *(
            (f"{other}: {how}", train_round.file(workspace, first, other))
            for other, how in OTHERS.items()
        ),
        *students,
    ]


def _draw(workspace: Workspace, say: Say) -> None:
    from pipelines.reports.pictures import draw_example_frame

    try:
        pictures = draw_example_frame(workspace, 1)
    except WorkspaceError:  # after a few steps, a teacher detects nothing
        say("   no picture: there are no labels; train longer with --steps")
        return
    for path in pictures:
        say(f"   picture: {_shown(path)}")


def _shown(path: Path) -> str:
    """Return a path relative to the current folder if it is inside, or else the path itself."""
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)
