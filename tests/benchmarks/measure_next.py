"""Measure AP after labeling 20 frames chosen by `curate next`, at random, or by lowest mean score.

For each seed, frames are simulated, a teacher is trained on a few of them, and its predictions on
the others are weighted. Each way of choosing then adds its frames to the labeled ones, and a
detector is trained on all of them from scratch, for the same number of steps. Reported is the mean
3D AP R40 (moderate) on val frames at KITTI's and at the relaxed IoU thresholds.

    PYTHONPATH=tests:. .venv/bin/python tests/benchmarks/measure_next.py FOLDER --seeds 0,1,2

Results are stored one by one in FOLDER/results.json; a run that was interrupted resumes. The
defaults take about 3 minutes per seed and training, with five trainings per seed.
"""

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import mean

import numpy as np
from support.silent import Silent

from curate.evaluation.comparison import known_mean
from curate.evaluation.kitti_ap import FIGURES
from curate.evaluation.kitti_rules import relaxed
from curate.simulation import simulate
from pipelines.assessment.evaluation import detect_val, val_objects
from pipelines.engine.rounds import find_teacher
from pipelines.engine.runner import open_executor, run_first, run_frames, run_round
from pipelines.review.next_frames import rank_frames
from pipelines.round import graph_of, open_plan
from pipelines.workspace.config import Config, make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

Figures = dict[str, float]


def chosen_by_next(workspace: Workspace, count: int, policy: str, _seed: int) -> list[str]:
    """Return the frames of `curate next`."""
    return [each.frame for each in rank_frames(workspace, count, 1, policy).frames]


def chosen_at_random(workspace: Workspace, count: int, _policy: str, seed: int) -> list[str]:
    """Return random frames."""
    names = sorted(workspace.frames("unlabeled"))
    return np.random.default_rng([seed, 20]).choice(names, count, replace=False).tolist()


def chosen_by_score(workspace: Workspace, count: int, _policy: str, _seed: int) -> list[str]:
    """Return the frames with the lowest mean score; frames without predictions come last."""
    keys = workspace.frames("unlabeled")
    found = workspace.predictions(1, list(keys.values()))
    scores = {name: found[key].scores for name, key in keys.items()}
    means = {name: float(each.mean()) if len(each) else 1.0 for name, each in scores.items()}
    return sorted(means, key=lambda name: (means[name], name))[:count]


WAYS: dict[str, Callable[[Workspace, int, str, int], list[str]]] = {
    "next": chosen_by_next,
    "random": chosen_at_random,
    "lowest mean score": chosen_by_score,
    "none": lambda *_: [],
}


def settings(data: Path, seed: int, options: argparse.Namespace) -> Config:
    """Return the settings that all workspaces of a seed share."""
    document = {
        "dataset": {"root": data},
        "segmenter": {"name": "simulated", "cache": data / "maps"},
        "train": {"pretrain_steps": options.steps, "threads": 1},
        "run": {"seed": seed, "workers": 1, "rounds": 1},
    }
    return make_config(document, "measure_next")


def weighted(folder: Path, config: Config, labeled: str, policy: str) -> Workspace:
    """Return the workspace of the first teacher, with the weights of its labels."""
    workspace = initialise(folder, config, labeled, "")
    for first in graph_of(workspace).first_stages:
        run_first(workspace, first, Silent())
    plan = open_plan(workspace, 1)
    with open_executor(workspace) as executor:
        for stage in plan.graph.frames_stages:
            run_frames(plan, stage, executor, Silent())
    run_round(plan, "solve", policy, Silent())
    return workspace


def trained(folder: Path, config: Config, frames: Sequence[str]) -> Figures:
    """Train a detector on some frames, and return its AP on val."""
    folder.mkdir(parents=True, exist_ok=True)
    listed = folder / "labeled.txt"
    listed.write_text("".join(f"{name}\n" for name in sorted(frames)))
    workspace = initialise(folder, config, str(listed), "")
    for first in graph_of(workspace).first_stages:
        run_first(workspace, first, Silent())
    path = find_teacher(workspace, 1)[1].path
    objects = val_objects(workspace, detect_val(workspace, path, Silent()))
    thresholds = {"kitti": dict(objects.overlaps), "relaxed": relaxed(objects.overlaps)}
    figure = FIGURES.index("3d")
    return {
        name: float(known_mean(objects.evaluate(each).ap_r40[:, figure, 1], 1))
        for name, each in thresholds.items()
    }


def measure(options: argparse.Namespace) -> dict[str, Figures]:
    """Return the figures of every seed and way; stored ones are not measured again."""
    path = options.folder / "results.json"
    results: dict[str, Figures] = json.loads(path.read_text()) if path.exists() else {}
    for seed in options.seeds:
        home = options.folder / f"seed-{seed}"
        missing = [way for way in WAYS if f"{seed} {way}" not in results]
        if not missing:
            continue
        total = options.frames + options.val
        data = home / "data"
        simulate(data, total, options.data_seed + seed, val_frames=options.val, workers=1)
        config = settings(data, seed, options)
        share = str(options.labeled / options.frames)
        workspace = weighted(home / "teacher", config, share, options.policy)
        labeled = list(workspace.frames("labeled"))
        for way in missing:
            chosen = WAYS[way](workspace, options.count, options.policy, seed)
            truth = sum(len(workspace.dataset.annotations(name)) for name in chosen)
            figures = trained(home / way.replace(" ", "-"), config, [*labeled, *chosen])
            results[f"{seed} {way}"] = {**figures, "boxes": truth}
            path.write_text(json.dumps(results, indent=1))
            print(seed, way, results[f"{seed} {way}"], flush=True)  # noqa: T201
    return results


def table(results: dict[str, Figures], seeds: Sequence[int]) -> str:
    """Return the means over the seeds as a Markdown table, with the differences to random."""
    lines = ["| 20 frames chosen | boxes | AP relaxed | AP KITTI | relaxed - random, by seed |"]
    lines.append("|---|---|---|---|---|")
    for way in WAYS:
        own = [results[f"{seed} {way}"] for seed in seeds]
        other = [results[f"{seed} random"] for seed in seeds]
        boxes, loose, strict = (
            mean(each[name] for each in own) for name in ("boxes", "relaxed", "kitti")
        )
        differences = ", ".join(
            f"{mine['relaxed'] - random['relaxed']:+.1f}"
            for mine, random in zip(own, other, strict=True)
        )
        lines.append(f"| {way} | {boxes:.0f} | {loose:.1f} | {strict:.1f} | {differences} |")
    return "\n".join(lines)


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=lambda text: [int(each) for each in text.split(",")])
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--val", type=int, default=150)
    parser.add_argument("--labeled", type=int, default=16)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--policy", default="pspsl", help="policy of the weights, e.g. learned")
    parser.add_argument("--data-seed", type=int, default=100)
    parser.set_defaults(seeds=[0, 1, 2])
    options = parser.parse_args()
    options.folder = options.folder.resolve()
    options.folder.mkdir(parents=True, exist_ok=True)
    print(table(measure(options), options.seeds))  # noqa: T201


if __name__ == "__main__":
    main()
