"""fuse: replace the box of each label by the mean with its matched repredictions.

`prediction` keeps the box of the detector, `fused_box` has the box of the label. The consistency
loss L is that of the detector's box: it measures how well single predictions agree, and against
their own mean it would always be low. All later stages use the fused box: priors and other
evidence, policies, exports, reports, audit and training.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from sqlalchemy import func, select

from curate.detections import Detections
from curate.detectors.base import RecordedViews
from curate.errors import WorkspaceError
from curate.fusion import fuse_boxes
from curate.priors.base import Measured
from curate.warnings_once import warn_once
from db import bulk
from db.models import BOX_COLUMNS
from pipelines.assembly import detects_like
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import RoundContext, Settings
from pipelines.workspace.workspace import Workspace

ADVISED_VIEWS = 3
"""With fewer views, fused boxes were not better than those of the detector on real frames."""
_COLUMNS = ("matched_k", "score", *BOX_COLUMNS)


class Fuse:
    """Fuses the labels of a frame from its stored predictions and repredictions."""

    def open(self) -> None:
        """Load nothing."""

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the rows of `fused_box`, one per label."""
        if job.predictions is None or job.measured is None:
            raise WorkspaceError(f"frame {job.frame}: the job has no predictions or repredictions")
        found = job.measured
        matched = found["matched_k"].astype(np.int64)
        boxes = np.stack([found[name] for name in BOX_COLUMNS], axis=1)
        categories = job.predictions.categories[matched]
        repredictions = Detections(boxes, found["score"], categories)
        fused, count = fuse_boxes(job.predictions, repredictions, matched)
        return {
            "fused_box": {
                "k": list(range(len(fused))),
                **dict(zip(BOX_COLUMNS, fused.T.tolist(), strict=True)),
                "boxes": count.tolist(),
            }
        }


def settings(_workspace: Workspace, _context: RoundContext) -> Settings:
    """Return nothing: fused boxes depend on predictions and repredictions alone."""
    return {}


def function(workspace: Workspace, context: RoundContext) -> Fuse:
    """Return what fuse does with a frame; warn if results of a detector have few views."""
    table = bulk.table("consistency")
    query = select(func.max(table.c.views)).where(table.c.round == context.number)
    if _has_own_views(workspace):
        _warn_of_few(workspace.database.rows(query)[0][0] or 0, "views of the results:")
    return Fuse()


def check(workspace: Workspace) -> None:
    """Warn if there are few views."""
    if not _has_own_views(workspace):
        _warn_of_few(workspace.config.repredict.views, "repredict.views is")


def read_matched(
    workspace: Workspace, context: RoundContext, frame_ids: Sequence[int]
) -> Mapping[int, Measured]:
    """Return the matched repredictions of some frames by frame key, as columns."""
    table = bulk.table("reprediction")
    query = (
        select(table.c.frame_id, *(table.c[name] for name in _COLUMNS))
        .where(
            table.c.round == context.number,
            table.c.frame_id.in_(frame_ids),
            table.c.matched_k.is_not(None),
        )
        .order_by(table.c.frame_id, table.c.view, table.c.k)
    )
    found = bulk.grouped(workspace.database.rows(query), frame_ids)
    return {
        key: dict(
            zip(
                _COLUMNS,
                np.array(rows, dtype=np.float64).reshape(-1, len(_COLUMNS)).T,
                strict=True,
            )
        )
        for key, rows in found.items()
    }


def _has_own_views(workspace: Workspace) -> bool:
    """Return whether the copies come with the results, not from `repredict.views`."""
    config = workspace.config
    return detects_like(config, RecordedViews) and config.detector.augmented is None


def _warn_of_few(views: int, place: str) -> None:
    if views < ADVISED_VIEWS:
        warn_once(
            f"repredict.fuse = true: {place} {views}; use {ADVISED_VIEWS} or more, and "
            "compare the share of correct boxes before and after fusion with `curate audit`"
        )
