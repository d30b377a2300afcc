"""score: compute the evidence of every label. Each evidence source is a separate stage.

A source stores its measurements of a frame together with the trust that it computes from them. If
only the formula changes, the trust is computed again from the stored measurements, without reading
the frame.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from sqlalchemy import select

from curate.datasets.base import pose_of, time_of
from curate.errors import DataError, WorkspaceError
from curate.frames import Frame
from curate.priors.base import (
    Evidence,
    EvidenceSource,
    Measured,
    SequenceFrame,
    check_evidence,
)
from curate.priors.points import learn_thresholds
from curate.priors.semantic import usable_references
from db import bulk
from pipelines.assembly import (
    check_prior,
    open_prior,
    open_sequence_source,
    point_settings,
)
from pipelines.devices import segmenter_place
from pipelines.engine.executors.base import FrameJob, FrameRows, SequenceJob
from pipelines.engine.stage import (
    FramesStage,
    FrameStage,
    ReusableMeasurements,
    RoundContext,
    SequenceStage,
    Settings,
)
from pipelines.labels.sources import (
    Source,
    check_sequences,
    prepare_stage,
    source_of,
    sources_of,
)
from pipelines.registry import PRIORS
from pipelines.stages.reading import FrameReader, ReadsAhead
from pipelines.stages.references import settings_of_segmenter, share_references
from pipelines.workspace.config import Config
from pipelines.workspace.images import check_reference, check_segmentable
from pipelines.workspace.workspace import Workspace, open_dataset


@dataclass
class Score(ReadsAhead):
    """Scores the labels of a frame with one source.

    Attributes:
        config: the configuration.
        source: name of the source in run.priors.
        thresholds: points per category, learned from X_l, for sources with this argument.
        references: S/A per category, learned from X_l, for sources with this argument.
    """

    config: Config
    source: str
    thresholds: Mapping[str, float]
    references: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        place = segmenter_place(self.config) if PRIORS.takes(self.source, "segmenter") else None
        self.exclusive = place is not None and place.exclusive

    def open(self) -> None:
        """Open the data set, the source and its models."""
        self.dataset = open_dataset(self.config)
        self.read = FrameReader(self._read)
        self.prior = self._opened(measures=True)

    def _opened(self, *, measures: bool) -> EvidenceSource:
        return open_prior(
            self.config,
            self.source,
            self.thresholds,
            references=self.references,
            measures=measures,
        )

    def _read(self, frame_id: str) -> Frame:
        """Return what the source needs of a frame."""
        needs = self.prior
        return self.dataset.read(frame_id, points=needs.needs_points, image=needs.needs_image)

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the rows of the source's table."""
        if job.predictions is None:
            raise WorkspaceError(f"frame {job.frame}: the job has no predictions")
        frame = self.read(job.frame)
        return self.rows(self.prior.score(frame, job.predictions), len(job.predictions))

    def rows(self, evidence: Evidence, count: int) -> FrameRows:
        """Return the evidence of a frame's labels as columns of the source's table."""
        found = check_evidence(self.prior, evidence, count)
        return {source_of(self.source).table: {"k": list(range(count)), **found}}


class Rescore(Score):
    """Scores the labels of a frame from stored measurements."""

    def __post_init__(self) -> None:
        self.exclusive = False

    def open(self) -> None:
        """Open the source alone, without data set and segmenter."""
        self.prior = self._opened(measures=False)

    def __call__(self, job: FrameJob) -> FrameRows:
        """Return the rows of the source's table."""
        if job.predictions is None or job.measured is None:
            raise WorkspaceError(
                f"frame {job.frame}: the job has no predictions or no measurements"
            )
        evidence = self.prior.rate(job.predictions, job.measured)
        return self.rows(evidence, len(job.predictions))


@dataclass
class ScoreSequence:
    """Scores the labels of a whole sequence with one source.

    Attributes:
        config: the configuration.
        source: name of the source in run.priors.
    """

    config: Config
    source: str

    def open(self) -> None:
        """Open the data set and the source."""
        self.dataset = open_dataset(self.config)
        self.opened = open_sequence_source(self.config, self.source)

    def __call__(self, job: SequenceJob) -> Sequence[FrameRows]:
        """Return the rows of the source's table for each frame."""
        frames = []
        for each in job.frames:
            if each.predictions is None:
                raise WorkspaceError(f"frame {each.frame}: the job has no predictions")
            frames.append(
                SequenceFrame(
                    each.frame,
                    each.predictions,
                    partial(self.dataset.read, each.frame),
                    time_of(self.dataset, each.frame),
                    pose_of(self.dataset, each.frame),
                )
            )
        found = self.opened.score_sequence(frames)
        table = source_of(self.source).table
        return [
            {
                table: {
                    "k": list(range(len(frame.detections))),
                    **check_evidence(self.opened, evidence, len(frame.detections)),
                }
            }
            for frame, evidence in zip(frames, found, strict=True)
        ]


def stage(
    source: Source,
    maps: Sequence[str] = (),
    boxes: Sequence[str] = (),
    *,
    relative: bool = False,
) -> FramesStage:
    """Return the stage of a source.

    Args:
        source: the source.
        maps: what a source with a segmenter reads besides: the stored maps, if there are any.
        boxes: the tables that replace the boxes of predictions, if there are any.
        relative: whether S/A is compared with labeled boxes (`semantic.reference`).
    """
    name = source.configured
    if source.of_sequences:
        return SequenceStage(
            name,
            command=f"score --prior {name}",
            reads=("frame", "prediction", *boxes),
            writes=(source.table,),
            settings=partial(_sequence_settings, source),
            function=lambda workspace, _context: ScoreSequence(workspace.config, name),
            check=partial(_check, name),
            prepare=partial(prepare_stage, source=source),
        )
    learned = PRIORS.takes(name, "thresholds") or (relative and PRIORS.takes(name, "references"))
    learns = ("ground_truth",) if learned else ()
    shown = tuple(maps) if PRIORS.takes(name, "segmenter") else ()
    return FrameStage(
        name,
        command=f"score --prior {name}",
        reads=("frame", *learns, *shown, "prediction", *boxes),
        writes=(source.table,),
        settings=partial(_settings, source),
        function=partial(_function, Score, name),
        reusable=ReusableMeasurements(
            reads=("frame", "prediction", *boxes),
            settings=partial(_measured_settings, source),
            read=partial(_read_measured, source),
            function=partial(_function, Rescore, name),
        ),
        check=partial(_check, name),
        prepare=partial(prepare_stage, source=source),
    )


def stages(
    names: Sequence[str],
    maps: Sequence[str] = (),
    boxes: Sequence[str] = (),
    *,
    relative: bool = False,
) -> tuple[FramesStage, ...]:
    """Return the stages of several sources.

    Args:
        names: names of the sources.
        maps: see `stage`.
        boxes: see `stage`.
        relative: see `stage`.

    Raises:
        ConfigError: if one is unknown or invalid, or two share a name or a column.
    """
    return tuple(stage(source, maps, boxes, relative=relative) for source in sources_of(names))


def reads_maps(names: Sequence[str]) -> bool:
    """Return whether one of the sources has a segmenter."""
    return any(PRIORS.takes(name, "segmenter") for name in names)


def _check(name: str, workspace: Workspace) -> None:
    if PRIORS.takes(name, "segmenter"):
        check_segmentable(workspace.config, workspace.dataset)
    if PRIORS.takes(name, "references"):
        check_reference(workspace.config, workspace.frames("labeled"))
    check_prior(workspace.config, name)
    check_sequences(workspace.config, workspace.dataset)


def _declared(source: Source) -> Settings:
    """Return the declaration of a source; nothing if its table is part of the schema."""
    if source.table in bulk.SCHEMA_TABLES:
        return {}
    return {"columns": repr(source.declaration.layout)}


def _settings(source: Source, workspace: Workspace, _context: RoundContext) -> Settings:
    """Return the settings of the formula, which rho depends on besides the measurements."""
    name = source.configured
    sections = {"thresholds": workspace.config.points, "settings": workspace.config.semantic}
    # Without a reference, the evidence is what it was before there was this setting.
    return {
        argument: section.model_dump(mode="json", exclude={"reference"})
        for argument, section in sections.items()
        if PRIORS.takes(name, argument)
    } | ({"reference": True} if _is_relative(workspace, name) else {})


def _sequence_settings(source: Source, workspace: Workspace, _context: RoundContext) -> Settings:
    """Return what the evidence of a sequence depends on besides its predictions."""
    options = workspace.config.run.prior_options.get(source.configured, {})
    return {"options": options, "known": _known_motion(workspace), **_declared(source)}


def _known_motion(workspace: Workspace) -> Settings:
    """Return whether the data set has times and poses, as its first frame shows."""
    dataset = workspace.dataset
    first = next(iter(dataset.frame_ids()), None)
    try:
        return {
            "times": first is not None and time_of(dataset, first) is not None,
            "poses": first is not None and pose_of(dataset, first) is not None,
        }
    except DataError:  # reported when the sequence is processed
        return {}


def _measured_settings(source: Source, workspace: Workspace, _context: RoundContext) -> Settings:
    """Return what the measurements depend on besides frame and predictions."""
    config, name = workspace.config, source.configured
    options = {"options": config.run.prior_options.get(name, {}), **_declared(source)}
    if not PRIORS.takes(name, "segmenter"):
        return options
    return {**options, **settings_of_segmenter(config)}


def _function(kind: type[Score], name: str, workspace: Workspace, _context: RoundContext) -> Score:
    """Return what score does with a frame; X_l is read here, once for all workers."""
    thresholds = _learned(workspace) if PRIORS.takes(name, "thresholds") else {}
    references = {}
    if _is_relative(workspace, name):
        references = usable_references(share_references(workspace))
    return kind(workspace.config, name, thresholds, references)


def _is_relative(workspace: Workspace, name: str) -> bool:
    """Return whether a source compares S/A with labeled boxes."""
    return workspace.config.semantic.reference and PRIORS.takes(name, "references")


def _learned(workspace: Workspace) -> Mapping[str, float]:
    """Return m_th of each category, learned from X_l."""
    truth = workspace.ground_truth("labeled")
    return learn_thresholds(
        ((workspace.dataset.read(frame), annotations) for frame, annotations in truth.items()),
        workspace.config.dataset.categories,
        point_settings(workspace.config),
    )


def _read_measured(
    source: Source, workspace: Workspace, context: RoundContext, frame_ids: Sequence[int]
) -> Mapping[int, Measured]:
    """Return the measured columns of some frames by frame key, each in the order of k."""
    table = bulk.table(source.table)
    names = (*source.measured_columns, *(each.name for each in source.further_columns))
    query = (
        select(table.c.frame_id, *(table.c[column] for column in names))
        .where(table.c.round == context.number, table.c.frame_id.in_(frame_ids))
        .order_by(table.c.frame_id, table.c.k)
    )
    return {
        key: dict(zip(names, map(_array, zip(*rows, strict=True)), strict=True))
        for key, rows in bulk.grouped(workspace.database.rows(query), frame_ids).items()
    }


def _array(values: Sequence[Any]) -> np.ndarray:
    """Return a stored column as an array, with NaN for null."""
    if None not in values:
        return np.array(values)
    has_text = any(isinstance(value, str) for value in values)
    return np.array(values, dtype=object if has_text else np.float64)
