"""What every registered policy promises."""

from dataclasses import replace

import numpy as np
import pytest

from curate.weighting.base import Age, Evidence, Memory
from pipelines.registry import POLICIES

AGES = [Age(1, 1), Age(1, 3), Age(3, 3)]


def columns(n: int, seed: int) -> dict:
    """What labels of this round and of the one before have in common."""
    rng = np.random.default_rng([seed, n])
    boxes = np.column_stack([rng.uniform(0, 10, (n, 3)), rng.uniform(1, 4, (n, 3)), np.zeros(n)])
    return {
        "frame_index": rng.integers(0, max(n // 4, 1), n),
        "category": rng.choice(["Car", "Pedestrian", "Cyclist"], n),
        "score": rng.random(n),
        "iou": rng.random(n),
        "boxes": boxes,
    }


def evidence(n: int, seed: int = 0, *, remembered: int | None = None) -> Evidence:
    """So many labels of a few frames and categories, a fifth of them without a match."""
    rng = np.random.default_rng(seed)
    loss = rng.exponential(size=n)
    loss[rng.random(n) < 0.2] = np.nan
    memory = None
    if remembered is not None:
        memory = Memory(**columns(remembered, seed + 1), v=rng.random(remembered))
    return Evidence(
        **columns(n, seed),
        loss=loss,
        rho={"rho_diff": rng.random(n), "rho_anno": rng.random(n)},
        memory=memory,
    )


@pytest.fixture(params=sorted(POLICIES.classes))
def policy(request: pytest.FixtureRequest):
    """Every registered policy with its default settings."""
    return POLICIES.build(request.param, offered={}, options={})


@pytest.mark.parametrize("age", AGES)
@pytest.mark.parametrize("n", [0, 1, 200])
@pytest.mark.parametrize("remembered", [None, 0, 150])
def test_weights_are_finite_and_between_0_and_1(policy, age: Age, n: int, remembered) -> None:
    """One weight per label, whatever the evidence; 0 for those that are dropped."""
    weights = policy.weigh(evidence(n, remembered=remembered), age)
    assert weights.v.shape == weights.lambda_u.shape == weights.dropped.shape == (n,)
    assert ((weights.v >= 0) & (weights.v <= 1)).all()
    assert not weights.v[weights.dropped].any()


def test_weights_do_not_depend_on_the_order_of_the_labels(policy) -> None:
    """A permutation of the labels permutes the weights."""
    labels = evidence(100, remembered=80)
    order = np.random.default_rng(1).permutation(100)
    shuffled = Evidence(
        labels.frame_index[order],
        labels.category[order],
        labels.score[order],
        labels.loss[order],
        {name: rho[order] for name, rho in labels.rho.items()},
        labels.iou[order],
        labels.boxes[order],
        labels.memory,
    )
    expected, got = policy.weigh(labels, Age(1, 2)), policy.weigh(shuffled, Age(1, 2))
    assert got.v == pytest.approx(expected.v[order])
    assert got.dropped.tolist() == expected.dropped[order].tolist()


def test_columns_that_a_policy_does_not_read_say_nothing_to_it(policy) -> None:
    """Where it names what it reads, the rest can be left unread."""
    labels, reads = evidence(100), policy.reads
    nothing = {
        "category": np.full(100, ""),
        **dict.fromkeys(("score", "iou"), np.full(100, np.nan)),
    }
    blank = {name: column for name, column in nothing.items() if name not in reads}
    if "loss" not in reads:
        blank["loss"] = np.full(100, np.nan)
    expected, got = (
        policy.weigh(labels, Age(1, 2)),
        policy.weigh(replace(labels, **blank), Age(1, 2)),
    )
    assert got.v.tolist() == expected.v.tolist()
    assert got.dropped.tolist() == expected.dropped.tolist()
    assert np.array_equal(got.lambda_u, expected.lambda_u, equal_nan=True)


def test_a_policy_goes_by_its_registered_name(policy, request: pytest.FixtureRequest) -> None:
    """So that weights in the database and settings agree."""
    assert policy.name in POLICIES.classes


def test_weights_do_not_depend_on_what_was_weighed_before(policy) -> None:
    """Asked again after other labels and ages, the same weights to the last bit."""
    before = policy.weigh(evidence(60), Age(1, 3))
    policy.weigh(evidence(30, seed=5), Age(3, 3))
    again = policy.weigh(evidence(60), Age(1, 3))
    np.testing.assert_array_equal(again.v, before.v)
    np.testing.assert_array_equal(again.lambda_u, before.lambda_u)
    assert before.v.dtype == before.lambda_u.dtype == np.float64


def test_the_evidence_is_left_as_it_is(policy) -> None:
    """Several policies weigh the same labels."""
    labels = evidence(50)
    for column in (labels.category, labels.score, labels.loss, *labels.rho.values()):
        column.flags.writeable = False
    weights = policy.weigh(labels, Age(2, 3))
    weights.v[:] = 0
    np.testing.assert_array_equal(labels.score, evidence(50).score)


def test_weights_do_not_need_every_prior(policy) -> None:
    """Without any prior, or with one that has scored some labels only, they stay in range."""
    labels = evidence(40)
    holes = np.where(np.arange(40) % 2, labels.rho["rho_diff"], np.nan)
    for rho in ({}, {"rho_diff": holes}):
        v = policy.weigh(replace(labels, rho=rho), Age(1, 1)).v
        assert ((v >= 0) & (v <= 1)).all()
