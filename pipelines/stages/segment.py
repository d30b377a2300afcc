"""segment: make the semantic map of every image once, and store it.

Everything that needs a map reads the stored one, or makes and stores it if it is missing, see
`curate.segmenters.map_store`. So this stage changes no result: it only makes the maps ahead, on all
workers, and no later round, audit or workspace makes them again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from db import bulk
from pipelines.assembly import (
    check_segmenter,
    check_segmenter_names,
    made_by,
    open_map_store,
    open_segmenter,
)
from pipelines.devices import segmenter_place
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import RoundContext
from pipelines.stages.reading import FrameReader, ReadsAhead
from pipelines.stages.references import stored_references
from pipelines.workspace.config import Config
from pipelines.workspace.images import check_segmentable
from pipelines.workspace.workspace import Workspace, open_dataset


@dataclass
class Segment(ReadsAhead):
    """Makes and stores the maps of a frame.

    Attributes:
        config: the configuration.
    """

    config: Config

    def __post_init__(self) -> None:
        place = segmenter_place(self.config)
        self.exclusive = place is not None and place.exclusive

    def open(self) -> None:
        """Open the data set and the segmenter."""
        self.read = FrameReader(partial(open_dataset(self.config).read, points=False))
        self.store = open_map_store(self.config)
        self.segmenter = open_segmenter(self.config, self.store)

    def __call__(self, job: FrameJob) -> FrameRows:
        """Store the map of each camera's image; return an entry if all of them are stored."""
        before = self.store.unstored
        for view in self.read(job.frame).views():
            self.segmenter.segment(view)
        return {"maps": {}} if self.store.unstored == before else {}


def settings(workspace: Workspace, _context: RoundContext) -> dict[str, Any]:
    """Return what the maps depend on besides the images."""
    return made_by(workspace.config)


def exists(workspace: Workspace) -> bool:
    """Return whether the folder of the maps is there."""
    return open_map_store(workspace.config).exists()


def ahead(workspace: Workspace) -> tuple[str, ...]:
    """Return the labeled frames if their maps are needed for `semantic.reference`."""
    needed = workspace.config.semantic.reference and not stored_references(workspace)
    return ("labeled",) if needed else ()


def prepare(workspace: Workspace) -> None:
    """Make the folder of the maps. If it was deleted, no map counts as made."""
    store = open_map_store(workspace.config)
    if not store.exists():
        with workspace.database.writing() as connection:
            task = bulk.table("task")
            connection.execute(task.delete().where(task.c.stage == "segment"))
        store.prepare()


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
