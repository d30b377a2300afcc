"""The contract of every registered evidence source: of those of a frame, then of a sequence."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from contracts.samples import assert_same
from support.toys import SIZES, ToySegmenter

from curate.detections import CATEGORIES, Detections
from curate.errors import ConfigError
from curate.priors.base import Evidence, SequenceFrame, check_evidence
from db.evidence import evidence_table
from db.models import Base
from pipelines.labels.sources import source_of
from pipelines.registry import PRIORS

# Options without which a prior cannot be created.
SAMPLES: dict[str, dict[str, Any]] = {}
THRESHOLDS = {"Car": 30.0, "Pedestrian": 12.5, "Cyclist": 1.0}
KEY = ("round", "frame_id", "k")


def build(name: str, *, measures: bool = True):
    """Return a prior as the pipeline builds it."""
    offered = {
        "thresholds": lambda: THRESHOLDS,
        "segmenter": lambda: ToySegmenter("none") if measures else None,
    }
    try:
        return PRIORS.build(name, offered=offered, options=SAMPLES.get(name, {}))
    except ConfigError as error:
        pytest.fail(f"{error}; where options are missing, add them to SAMPLES here")


OF_SEQUENCES = [name for name in sorted(PRIORS.classes) if source_of(name).of_sequences]
OF_FRAMES = [name for name in sorted(PRIORS.classes) if name not in OF_SEQUENCES]


@pytest.fixture(params=OF_FRAMES)
def prior(request: pytest.FixtureRequest):
    """Return every registered source of frames in turn."""
    return build(request.param)


def assert_same_evidence(one: Evidence, other: Evidence) -> None:
    """Check that two sets of evidence are equal to the last bit."""
    assert list(one) == list(other)
    for name, column in one.items():
        np.testing.assert_array_equal(column, other[name], err_msg=name)


def random_labels(count: int, seed: int = 0) -> Detections:
    """Return random boxes of all categories around the camera, some behind it, with all scores."""
    rng = np.random.default_rng(seed)
    categories = rng.choice(CATEGORIES, count).astype(np.str_)
    boxes = np.column_stack([
        rng.uniform(-8, 30, count), rng.uniform(-12, 12, count), rng.uniform(-1.5, 0.5, count),
        np.array([SIZES[str(c)] for c in categories]).reshape(-1, 3),
        rng.uniform(-np.pi, np.pi, count),
    ])  # fmt: skip
    scores = rng.random(count)
    scores[:2] = [0.0, 1.0][:count]
    return Detections(boxes, scores, categories)


@pytest.mark.parametrize("count", [0, 1, 60])
def test_evidence_has_the_declared_columns(prior, frames, count: int) -> None:
    """One value per label and column, in the declared order and type."""
    found = prior.score(frames[0], random_labels(count))
    assert list(found) == [column.name for column in prior.columns]
    for column in prior.columns:
        values = found[column.name]
        assert values.shape == (count,), column.name
        assert values.dtype.kind in ("iu" if column.kind.startswith("int") else "f"), column.name
        assert column.optional or np.isfinite(values).all(), column.name
    assert list(check_evidence(prior, found, count)) == list(found)


@pytest.mark.parametrize("name", sorted(PRIORS.classes))
def test_a_declaration_matches_its_table(name: str) -> None:
    """The columns are in order, each with a unit or none, and a meaning."""
    prior = build(name)
    declaration = source_of(name).declaration
    is_builtin = declaration.table in Base.metadata.tables
    table = Base.metadata.tables[declaration.table] if is_builtin else evidence_table(declaration)
    own = [column.name for column in table.columns if column.name not in KEY]
    assert own == [column.name for column in (*prior.columns, *prior.further_columns)]
    assert all(column.meaning for column in prior.columns)
    assert prior.name == name


def test_trust_lies_between_0_and_1(prior, frames) -> None:
    """For all scores, visible or not, with points or without; the values differ."""
    if prior.rho_column is None:
        pytest.skip("evidence, but not a prior")
    for frame in frames:
        rho = prior.score(frame, random_labels(80))[prior.rho_column]
        assert rho.dtype == np.float64
        assert ((rho >= 0) & (rho <= 1)).all()
        assert len(np.unique(rho)) > 1


def test_the_measured_columns_are_declared_and_exclude_the_trust(prior) -> None:
    assert prior.measured_columns
    names = {column.name for column in prior.columns}
    assert set(prior.measured_columns) <= names - {prior.rho_column}


def test_labels_do_not_affect_each_other(prior, frames) -> None:
    """A permutation of the labels permutes the evidence; a subset has the same values."""
    found = random_labels(50)
    whole = prior.score(frames[0], found)
    order = np.random.default_rng(1).permutation(50)
    for index in (order, order[:7]):
        part = prior.score(frames[0], found.select(index))
        for name, column in part.items():
            np.testing.assert_array_equal(column, whole[name][index], err_msg=name)


def test_the_order_of_the_points_does_not_matter(prior, frames) -> None:
    frame = frames[0]
    shuffled = frame.with_points(np.random.default_rng(0).permutation(frame.points))
    assert_same_evidence(
        prior.score(shuffled, random_labels(50)), prior.score(frame, random_labels(50))
    )


def test_evidence_does_not_depend_on_earlier_calls(prior, frames) -> None:
    """A second call, another order or another instance gives the same to the last bit."""
    before = [prior.score(frame, random_labels(20)) for frame in frames]
    other = build(prior.name)
    for frame, expected in reversed(list(zip(frames, before, strict=True))):
        assert_same_evidence(other.score(frame, random_labels(20)), expected)
        assert_same_evidence(prior.score(frame, random_labels(20)), expected)


def test_rating_measurements_gives_the_same_as_scoring(prior, frames) -> None:
    """Also by a prior that could not measure, from numbers that were in a database."""
    found = random_labels(40)
    measured = prior.measure(frames[0], found)
    assert set(measured) == set(prior.measured_columns)
    expected = prior.score(frames[0], found)
    assert_same_evidence(prior.rate(found, measured), expected)
    stored = {name: np.array(column.tolist()) for name, column in measured.items()}
    assert_same_evidence(build(prior.name, measures=False).rate(found, stored), expected)


def test_frame_and_labels_are_not_modified(prior, frames) -> None:
    frame = replace(frames[0], points=frames[0].points.copy(), image=frames[0].image.copy())
    found = random_labels(30)
    for array in (frame.points, frame.image, found.boxes, found.scores, found.categories):
        array.flags.writeable = False
    prior.score(frame, found)
    np.testing.assert_array_equal(frame.points, frames[0].points)
    assert_same(found, random_labels(30))


def test_a_sweep_without_points_does_not_fail(prior, frames) -> None:
    found = prior.score(frames[0].with_points(frames[0].points[:0]), random_labels(9))
    assert list(check_evidence(prior, found, 9)) == [column.name for column in prior.columns]


def test_the_image_is_read_only_if_it_is_needed(prior, frames) -> None:
    assert isinstance(prior.needs_image, bool)
    if not prior.needs_image:
        bare = replace(frames[0], image=None)
        assert_same_evidence(
            prior.score(bare, random_labels(9)), prior.score(frames[0], random_labels(9))
        )


@pytest.fixture(params=OF_SEQUENCES)
def sequence_source(request: pytest.FixtureRequest):
    """Return every registered source of sequences in turn."""
    return build(request.param)


def sequence(frames, counts=(30, 0, 20, 1), seed: int = 0) -> list[SequenceFrame]:
    """Return a sequence of frames with random labels."""
    return [
        SequenceFrame(
            f"0001_{i:06d}", random_labels(count, seed + i), lambda: frames[0], i / 10, np.eye(4)
        )
        for i, count in enumerate(counts)
    ]


def test_evidence_of_a_sequence_has_the_declared_columns(sequence_source, frames) -> None:
    """One value per label and column of each frame, in the declared order and type."""
    for counts in [(), (0,), (1,), (30, 0, 20, 1)]:
        found = sequence_source.score_sequence(sequence(frames, counts))
        assert len(found) == len(counts)
        for evidence, count in zip(found, counts, strict=True):
            stored = check_evidence(sequence_source, evidence, count)
            assert list(stored) == [column.name for column in sequence_source.columns]


def test_evidence_of_a_sequence_does_not_depend_on_orders(sequence_source, frames) -> None:
    """Of the labels within a frame, of the frames, and of earlier calls."""
    whole = sequence(frames)
    expected = sequence_source.score_sequence(whole)
    order = np.random.default_rng(2).permutation(30)
    first = replace(whole[0], detections=whole[0].detections.select(order))
    shuffled = sequence_source.score_sequence([*whole[:0:-1], first])
    for i, evidence in enumerate(reversed(shuffled)):
        for name, column in evidence.items():
            wanted = expected[i][name][order] if i == 0 else expected[i][name]
            np.testing.assert_allclose(column, wanted, rtol=1e-12, atol=1e-12, err_msg=name)


def test_labels_of_a_sequence_are_not_modified(sequence_source, frames) -> None:
    whole = sequence(frames)
    for each in whole:
        for array in (each.detections.boxes, each.detections.scores, each.pose):
            array.flags.writeable = False
    sequence_source.score_sequence(whole)


def test_a_source_of_sequences_is_explained_in_one_line(sequence_source) -> None:
    line = sequence_source.describe({column.name: "1" for column in sequence_source.columns})
    assert line
    assert "\n" not in line
