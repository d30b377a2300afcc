"""segment: make the semantic map of every image once, and store it.

Everything that needs a map reads the stored one, or makes and stores it if it is missing, see
`curate.segmenters.map_store`. So this stage changes no result: it only makes the maps ahead, on all
workers, and no later round, audit or workspace makes them again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pipelines.assembly import (
    check_segmenter,
    check_segmenter_names,
    made_by,
    open_map_store,
    open_segmenter,
)
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import RoundContext
from pipelines.workspace.config import Config
from pipelines.workspace.images import check_segmentable
from pipelines.workspace.workspace import Workspace, open_dataset


@dataclass
class Segment:
    """Makes and stores the maps of a frame.

    Attributes:
        config: the configuration.
    """

    config: Config

    def open(self) -> None:
        """Open the data set and the segmenter."""
        self.dataset = open_dataset(self.config)
        self.segmenter = open_segmenter(self.config)

    def __call__(self, job: FrameJob) -> FrameRows:
        """Store the map of each camera's image; there are no rows."""
        for view in self.dataset.read(job.frame, points=False).views():
            self.segmenter.segment(view)
        return {}


def settings(workspace: Workspace, _context: RoundContext) -> dict[str, Any]:
    """Return what the maps depend on besides the images."""
    return made_by(workspace.config)


def function(workspace: Workspace, _context: RoundContext) -> Segment:
    """Return what segment does with a frame."""
    return Segment(workspace.config)


def check(workspace: Workspace) -> None:
    """Check that the frames can be segmented.

    Raises:
        CurateError: if the data set has no images, or a setting of the segmenter is wrong.
    """
    check_segmentable(workspace.config, workspace.dataset)
    check_segmenter_names(workspace.config)
    check_segmenter(workspace.config)


def refusal(workspace: Workspace) -> Callable[[], str]:
    """Return a function that returns why no further map can be stored; "" if one can."""
    return open_map_store(workspace.config).refusal
