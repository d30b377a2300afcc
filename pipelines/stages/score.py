"""score: a prior trusts or mistrusts every label of a frame; each prior is a stage of its own.

What a prior measures in a frame is stored beside the trust that follows from it. Where only the
formula has changed, its labels are rated again from what is stored, without a look at the frame.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from sqlalchemy import select

from curate.errors import ConfigError, WorkspaceError
from curate.priors.base import Measured, PriorEvidence, columns
from curate.priors.points import learn_thresholds
from db import bulk
from pipelines.assembly import open_prior, open_segmenter, point_settings, segmenter_path
from pipelines.engine.executors.base import FrameJob, FrameRows
from pipelines.engine.stage import FrameStage, Recall, RoundContext, Settings
from pipelines.registry import PRIORS
from pipelines.workspace.config import Config
from pipelines.workspace.workspace import Workspace, glance, open_dataset, sha256

# Where evidence is stored, by the column of its trust; at most one prior fills each.
TABLES = {"rho_diff": "point_prior", "rho_anno": "semantic_prior"}


@dataclass
class Score:
    """Asks one prior about the labels of a frame.

    Attributes:
        config: all sections.
        prior_name: whom to ask.
        thresholds: learned from X_l, for priors that name them.
    """

    config: Config
    prior_name: str
    thresholds: Mapping[str, float]

    def open(self) -> None:
        """Loads the data set and what the prior needs."""
        self.dataset = open_dataset(self.config)
        self.prior = open_prior(self.config, self.prior_name, self.thresholds)

    def __call__(self, job: FrameJob) -> FrameRows:
        """The rows of the prior's table."""
        if job.predictions is None:
            raise WorkspaceError(f"frame {job.frame} came without its predictions")
        points = getattr(self.prior, "needs_points", True)
        frame = self.dataset.read(job.frame, points=points, image=self.prior.needs_image)
        return self.rows(self.prior.score(frame, job.predictions))

    def rows(self, evidence: PriorEvidence) -> FrameRows:
        """The evidence as rows."""
        found = {name: column.tolist() for name, column in columns(evidence).items()}
        count = len(evidence.rho)
        return {TABLES[self.prior.rho_column]: {"k": list(range(count)), **found}}


class Rate(Score):
    """Rates the labels of a frame from what was measured before."""

    def open(self) -> None:
        """Needs neither data set nor segmenter."""
        self.prior = open_prior(self.config, self.prior_name, self.thresholds, measures=False)

    def __call__(self, job: FrameJob) -> FrameRows:
        """The rows of the prior's table."""
        if job.predictions is None or job.measured is None:
            raise WorkspaceError(f"frame {job.frame} came without predictions and measurements")
        return self.rows(self.prior.rate(job.predictions, job.measured))


@cache
def stage(name: str) -> FrameStage:
    """The stage that asks a prior.

    Raises:
        ConfigError: there is no such prior, or no table for its evidence.
    """
    learns = ("ground_truth",) if PRIORS.takes(name, "thresholds") else ()
    return FrameStage(
        name,
        command=f"score --prior {name}",
        reads=("frame", *learns, "prediction"),
        writes=(table_of(name),),
        settings=partial(_settings, name),
        function=partial(_function, Score, name),
        recall=Recall(
            reads=("frame", "prediction"),
            settings=partial(_measured_settings, name),
            read=partial(_read_measured, name),
            function=partial(_function, Rate, name),
        ),
        check=partial(_check, name),
    )


def stages(names: Sequence[str]) -> tuple[FrameStage, ...]:
    """The stages of several priors.

    Raises:
        ConfigError: two of them would be stored in the same place.
    """
    found = tuple(map(stage, names))
    for i, one in enumerate(found):
        for other in found[:i]:
            if one.writes == other.writes:
                raise ConfigError(
                    f"run.priors: {other.name} and {one.name} are both stored in {one.writes[0]}; "
                    "name one of them"
                )
    return found


def table_of(name: str) -> str:
    """Where a prior's evidence is stored.

    Raises:
        ConfigError: there is no such prior, or no table for its evidence.
    """
    column = PRIORS.load(name).rho_column
    if column not in TABLES:
        raise ConfigError(
            f"prior '{name}' answers {column}, but only {' and '.join(TABLES)} can be stored"
        )
    return TABLES[column]


def _check(name: str, workspace: Workspace) -> None:
    """ConfigError where the segmenter of a prior that needs one cannot be opened."""
    if PRIORS.takes(name, "segmenter"):
        open_segmenter(workspace.config)


def _settings(name: str, workspace: Workspace, _context: RoundContext) -> Settings:
    """What rho depends on beside predictions, ground truth and measurements: the formula."""
    sections = {"thresholds": workspace.config.points, "settings": workspace.config.semantic}
    return {
        argument: section.model_dump(mode="json")
        for argument, section in sections.items()
        if PRIORS.takes(name, argument)
    }


def _measured_settings(name: str, workspace: Workspace, _context: RoundContext) -> Settings:
    """What measurements depend on beside frame and predictions."""
    config = workspace.config
    options = {"options": config.run.prior_options.get(name, {})}
    if not PRIORS.takes(name, "segmenter"):
        return options
    path = segmenter_path(config)
    segmenter = config.segmenter.model_dump(mode="json", exclude={"path"})
    return {**options, "segmenter": segmenter, "model": _identity(path)}


def _identity(path: Path | None) -> str:
    """What tells a model, or a folder of saved maps, from another one in its place."""
    if path is not None and path.is_dir():
        return glance(path)
    return sha256(path) if path is not None and path.is_file() else str(path)


def _function(kind: type[Score], name: str, workspace: Workspace, _context: RoundContext) -> Score:
    """What score does with a frame; X_l is read here, once."""
    thresholds = _learned(workspace) if PRIORS.takes(name, "thresholds") else {}
    return kind(workspace.config, name, thresholds)


def _learned(workspace: Workspace) -> Mapping[str, float]:
    """m_th of each category, from X_l."""
    truth = workspace.ground_truth("labeled")
    learned = learn_thresholds(
        ((workspace.dataset.read(frame), annotations) for frame, annotations in truth.items()),
        workspace.config.dataset.categories,
        point_settings(workspace.config),
    )
    return learned.values


def _read_measured(
    name: str, workspace: Workspace, context: RoundContext, frame_ids: Sequence[int]
) -> Mapping[int, Measured]:
    """The measured columns of some frames, in the order of k."""
    table = bulk.table(table_of(name))
    names = PRIORS.load(name).measured_columns
    query = (
        select(table.c.frame_id, *(table.c[column] for column in names))
        .where(table.c.round == context.number, table.c.frame_id.in_(frame_ids))
        .order_by(table.c.frame_id, table.c.k)
    )
    found: dict[int, list[bulk.Row]] = {key: [] for key in frame_ids}
    with workspace.database.reading() as connection:
        for key, *row in bulk.select(connection, query):
            found[key].append(tuple(row))
    return {
        key: dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))
        for key, rows in found.items()
    }
