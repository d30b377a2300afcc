"""The contract of every registered policy."""

from dataclasses import replace

import numpy as np
import pytest

from curate.weighting.base import Age, Evidence, Memory
from pipelines.registry import POLICIES

AGES = [Age(1, 1), Age(1, 3), Age(3, 3)]


def random_columns(n: int, seed: int) -> dict:
    """Return random columns as both this round and the round before have them."""
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
    """Return random labels of a few frames and categories, a fifth of them without a match."""
    rng = np.random.default_rng(seed)
    loss = rng.exponential(size=n)
    loss[rng.random(n) < 0.2] = np.nan
    memory = None
    if remembered is not None:
        memory = Memory(**random_columns(remembered, seed + 1), v=rng.random(remembered))
    return Evidence(
        **random_columns(n, seed),
        loss=loss,
        rho={"rho_diff": rng.random(n), "rho_anno": rng.random(n)},
        memory=memory,
        probability=rng.random(n),
        p_value=rng.random(n),
    )


@pytest.fixture(params=sorted(POLICIES.classes))
def policy(request: pytest.FixtureRequest):
    """Return every registered policy with its default settings."""
    return POLICIES.build(request.param, offered={}, options={})


@pytest.mark.parametrize("age", AGES)
@pytest.mark.parametrize("n", [0, 1, 200])
@pytest.mark.parametrize("remembered", [None, 0, 150])
def test_weights_are_finite_and_between_0_and_1(policy, age: Age, n: int, remembered) -> None:
    """There is one weight per label; dropped labels have weight 0."""
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
        probability=labels.probability[order],
        p_value=labels.p_value[order],
    )
    expected, got = policy.weigh(labels, Age(1, 2)), policy.weigh(shuffled, Age(1, 2))
    assert got.v == pytest.approx(expected.v[order])
    assert got.dropped.tolist() == expected.dropped[order].tolist()


def test_undeclared_columns_do_not_change_the_weights(policy) -> None:
    """If a policy declares the columns that it reads, the others can be left unread."""
    labels, reads = evidence(100), policy.reads
    nothing = {
        "category": np.full(100, ""),
        **dict.fromkeys(("score", "iou", "probability", "p_value"), np.full(100, np.nan)),
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


def test_a_policy_has_its_registered_name(policy, request: pytest.FixtureRequest) -> None:
    """Weights in the database and settings then agree."""
    assert policy.name in POLICIES.classes


def test_weights_do_not_depend_on_earlier_calls(policy) -> None:
    """After other labels and ages, the same input gives the same weights to the last bit."""
    before = policy.weigh(evidence(60), Age(1, 3))
    policy.weigh(evidence(30, seed=5), Age(3, 3))
    again = policy.weigh(evidence(60), Age(1, 3))
    np.testing.assert_array_equal(again.v, before.v)
    np.testing.assert_array_equal(again.lambda_u, before.lambda_u)
    assert before.v.dtype == before.lambda_u.dtype == np.float64


def test_the_evidence_is_not_modified(policy) -> None:
    labels = evidence(50)
    for column in (labels.category, labels.score, labels.loss, *labels.rho.values()):
        column.flags.writeable = False
    weights = policy.weigh(labels, Age(2, 3))
    weights.v[:] = 0
    np.testing.assert_array_equal(labels.score, evidence(50).score)


def test_weights_do_not_need_every_prior(policy) -> None:
    """Without any prior, or with one that scored only some labels, they stay in range."""
    labels = evidence(40)
    holes = np.where(np.arange(40) % 2, labels.rho["rho_diff"], np.nan)
    for rho in ({}, {"rho_diff": holes}):
        v = policy.weigh(replace(labels, rho=rho), Age(1, 1)).v
        assert ((v >= 0) & (v <= 1)).all()
