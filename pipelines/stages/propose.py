"""propose: objects that have no label, stored in the table `proposal` for review.

It is not a stage of the graph: nothing but people and `train.ignore_proposals` uses its results.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from sqlalchemy import select

from curate.detections import Annotations, Detections, as_categories, empty_boxes
from curate.detectors.base import IgnoredRegions
from curate.errors import ConfigError, FramesFailed, WorkspaceError
from curate.evaluation.proposals import PROVENANCE, mean_sizes, propose_objects
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.assembly import check_executor, check_segmenter_names, open_segmenter
from pipelines.devices import segmenter_place
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.mapping import map_frames
from pipelines.engine.progress import Progress
from pipelines.engine.runner import open_executor
from pipelines.labels.by_frame import chosen_round, not_weighted_error, weighted_round
from pipelines.labels.columns import read_columns
from pipelines.review.selection import CONTEXT_WEIGHT, decided_boxes
from pipelines.stages.reading import FrameReader, ReadsAhead
from pipelines.workspace.config import Config
from pipelines.workspace.images import why_not_segmented
from pipelines.workspace.splits import SPLITS
from pipelines.workspace.workspace import Workspace, open_dataset

_log = logging.getLogger(__name__)

_FrameColumns = tuple[int, Mapping[str, Sequence[Any]]]

TRUTH_ROUND = 0
"""The round of proposals in frames with ground truth, which depend on no round."""


@dataclass(frozen=True)
class ProposedObjects:
    """What was proposed.

    Attributes:
        round: round of the labels; 0 for ground truth.
        frames: number of frames without the failed ones.
        categories: number of proposals by category.
        failed: number of frames that failed.
    """

    round: int
    frames: int
    categories: Mapping[str, int]
    failed: int


@dataclass
class Propose(ReadsAhead):
    """Proposes objects in a frame; the labels are the predictions of its job.

    Attributes:
        config: the configuration.
        sizes: mean size of each category.
        regions: parts of the image to leave out, by frame.
    """

    config: Config
    sizes: Mapping[str, np.ndarray]
    regions: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        place = segmenter_place(self.config)
        self.exclusive = place is not None and place.exclusive

    def open(self) -> None:
        """Open the data set and the segmenter."""
        self.segmenter = open_segmenter(self.config)
        needs_image = self.segmenter.needs_image
        self.read = FrameReader(partial(open_dataset(self.config).read, image=needs_image))

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the rows of the frame."""
        frame = self.read(job.frame)
        labels = empty_boxes() if job.predictions is None else job.predictions.boxes
        regions = self.regions.get(job.frame)
        found = propose_objects(frame, self.segmenter, labels, self.sizes, regions=regions)
        boxes = dict(zip(BOX_COLUMNS, found.boxes.T.tolist(), strict=True))
        return {
            "proposal": {
                "n": list(range(len(found))),
                "category": found.categories.tolist(),
                **boxes,
                "points": found.points.tolist(),
                "pixels": found.pixels.tolist(),
                "camera": [name or None for name in found.cameras.tolist()],
                "provenance": [PROVENANCE] * len(found),
            }
        }


def propose(
    workspace: Workspace,
    split: str,
    round_number: int | None,
    policy: str | None,
    progress: Progress,
) -> ProposedObjects:
    """Propose objects in the frames of a split, and replace those stored before.

    In unlabeled frames, labels with a weight of at least 0.1 and everything that people decided
    about are labeled; in the others, the ground truth is.

    Raises:
        ConfigError: if the split is unknown, or no segmenter is configured.
        WorkspaceError: if there are no labels yet, or no labeled object to learn sizes from.
        FramesFailed: if all frames failed.
    """
    sizes = _checked_sizes(workspace, split)
    frames = workspace.frames(split)
    regions: dict[str, np.ndarray] = {}
    if split == "unlabeled":
        number, labels = _weighted_labels(workspace, round_number, policy)
    else:
        number, truth = TRUTH_ROUND, workspace.ground_truth(split)
        labels = {name: each.boxes[_has_box(each)] for name, each in truth.items()}
        regions = {name: each.boxes_2d[~_has_box(each)] for name, each in truth.items()}
    jobs = [
        FrameJob(key, name, _as_predictions(labels.get(name, empty_boxes())))
        for name, key in frames.items()
    ]
    rows, failed = _run(workspace, Propose(workspace.config, sizes, regions), jobs, progress)
    for title, error in failed[:5]:
        _log.warning("%s is left out: %s", title, error)
    if failed and not rows:
        raise FramesFailed(f"all {len(failed)} frames failed; the first: {failed[0][1]}")
    _store(workspace, number, rows)
    names = [name for _, columns in rows for name in columns["category"]]
    counts = {name: names.count(name) for name in sizes}
    return ProposedObjects(number, len(rows), counts, len(failed))


def _checked_sizes(workspace: Workspace, split: str) -> dict[str, np.ndarray]:
    """Return the mean size of each category in X_l, after all checks that need no frame."""
    config = workspace.config
    if split not in SPLITS:
        raise ConfigError(f"--split {split}: use one of {', '.join(SPLITS)}")
    check_executor(config)
    check_proposable(workspace)
    if not workspace.frames(split):
        raise WorkspaceError(f"there are no {split} frames")
    truth = list(workspace.ground_truth("labeled").values())
    sizes = mean_sizes(truth, config.dataset.categories)
    if not sizes:
        raise WorkspaceError(
            "the labeled frames have no object of dataset.categories, so the size of a proposal is "
            "unknown; label some frames first"
        )
    return sizes


def check_proposable(workspace: Workspace) -> None:
    """Raise ConfigError if there is no segmenter, or nothing for it to segment."""
    config = workspace.config
    if config.segmenter.name == "none":
        raise ConfigError(
            "segmenter.name is 'none', and proposals are made from its masks; set segmenter.name "
            "and segmenter.path in curate.toml"
        )
    if reason := why_not_segmented(config, workspace.dataset):
        raise ConfigError(f"no proposals: {reason}")
    check_segmenter_names(config)


def _run(
    workspace: Workspace, function: Propose, jobs: Sequence[FrameJob], progress: Progress
) -> tuple[list[_FrameColumns], list[tuple[str, str]]]:
    """Return the columns of each frame by its key, and the frames that failed with their errors."""
    rows: list[_FrameColumns] = []
    failed: list[tuple[str, str]] = []
    with progress.track("propose", len(jobs)) as advance, open_executor(workspace) as executor:
        for outcome in map_frames(executor, function, jobs, len(jobs)):
            if outcome.error is not None:
                failed.append((outcome.job.title, outcome.error))
            else:
                pairs = zip(outcome.job.frames, outcome.rows, strict=True)
                rows += [(job.frame_id, found["proposal"]) for job, found in pairs]
            advance(len(outcome.job.frames), "")
    return rows, failed


def proposed_regions(workspace: Workspace, round_number: int) -> IgnoredRegions:
    """Return the stored proposals of the unlabeled frames by frame name, for a training."""
    table, frame = bulk.table("proposal"), bulk.table("frame")
    query = (
        select(frame.c.frame, table.c.category, *(table.c[name] for name in BOX_COLUMNS))
        .join(frame, frame.c.id == table.c.frame_id)
        .where(table.c.round == round_number, frame.c.split == "unlabeled")
        .order_by(frame.c.frame, table.c.n)
    )
    return {
        name: (np.array([row[1:] for row in rows]), as_categories([row[0] for row in rows]))
        for name, rows in bulk.grouped(workspace.database.rows(query)).items()
    }


def _weighted_labels(
    workspace: Workspace, round_number: int | None, policy: str | None
) -> tuple[int, dict[str, np.ndarray]]:
    """Return the round, and the boxes of its labels by frame."""
    policy = policy or workspace.config.run.method
    number = weighted_round(workspace, policy, round_number)
    if number is None:
        raise not_weighted_error(chosen_round(workspace, round_number), policy)
    found = read_columns(workspace, number, policy)
    of_frame: dict[str, list[np.ndarray]] = {}
    for row in np.flatnonzero(found.weights >= CONTEXT_WEIGHT).tolist():
        of_frame.setdefault(found.frame_names[found.frames[row]], []).append(found.boxes[row])
    for name, boxes in decided_boxes(workspace).items():
        of_frame.setdefault(name, []).extend(boxes)
    return number, {name: np.array(boxes) for name, boxes in of_frame.items()}


def _store(workspace: Workspace, number: int, rows: Sequence[_FrameColumns]) -> None:
    """Replace the proposals of some frames; those of others, such as failed ones, are kept."""
    table = bulk.table("proposal")
    wanted = {key for key, _ in rows}
    with workspace.database.writing() as connection:
        stored = select(table.c.frame_id).where(table.c.round == number).distinct()
        old = [key for (key,) in bulk.select(connection, stored) if key in wanted]
        for key in old:
            connection.execute(
                table.delete().where(table.c.round == number, table.c.frame_id == key)
            )
        for key, columns in rows:
            if columns["n"]:
                bulk.insert(connection, "proposal", {"round": number, "frame_id": key, **columns})


def _has_box(truth: Annotations) -> np.ndarray:
    return np.asarray(~np.isnan(truth.boxes).any(axis=1))


def _as_predictions(boxes: np.ndarray) -> Detections:
    """Return boxes as detections, the form in which a job carries them."""
    n = len(boxes)
    return Detections(boxes, np.ones(n), as_categories([""] * n))
