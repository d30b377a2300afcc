"""SPSL-3D and PSPSL-3D against their objectives, and their limit cases."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import self_paced as oracle

from curate.detections import as_categories
from curate.errors import ConfigError
from curate.weighting.base import Age, Evidence
from curate.weighting.self_paced import PSPSL, SPSL, age_parameter, easiness, limit_unseen

# Losses far enough from 0 that the objective's minimum can be found on a grid, and exact zeros.
LOSSES = st.one_of(st.just(0.0), st.just(np.nan), st.floats(1e-3, 20.0))
AGES = st.sampled_from([Age(1, 1), Age(1, 3), Age(2, 3), Age(1, 10), Age(10, 10)])
SCOPES = st.sampled_from(["round", "category", "frame"])


def evidence(loss, rho=(), frame_index=None, category=None):
    """Return evidence of labels, by default of one frame and category."""
    n = len(loss)
    return Evidence(
        frame_index=np.zeros(n, np.int64) if frame_index is None else np.array(frame_index),
        category=as_categories(["Car"] * n if category is None else category),
        score=np.full(n, 0.5),
        loss=np.array(loss, dtype=np.float64),
        rho={f"rho_{i}": np.array(column, dtype=np.float64) for i, column in enumerate(rho)},
    )


@st.composite
def rounds(draw):
    """Draw evidence of a few labels over a few frames and categories."""
    rows = draw(
        st.lists(
            st.tuples(
                LOSSES, st.floats(0, 1), st.floats(0, 1), st.integers(3, 5), st.sampled_from("ab")
            ),
            max_size=12,
        )
    )
    return evidence(
        [row[0] for row in rows],
        [[row[1] for row in rows], [row[2] for row in rows]],
        np.array([row[3] for row in rows], np.int64),
        [row[4] for row in rows],
    )


def same(found, expected):
    """Return whether two columns agree, NaN with NaN."""
    return np.allclose(found, np.array(expected, dtype=np.float64), equal_nan=True)


@given(st.floats(0.0, 20.0), st.floats(1e-3, 20.0))
def test_equation_7_minimises_its_objective(loss, lambda_u):
    """The closed form is the best v of a grid over [0, 1]."""
    v = easiness(np.array([loss]), np.array([lambda_u]))[0]
    assert v == pytest.approx(oracle.spsl_weight(loss, lambda_u), abs=1e-4)


@given(st.floats(0.0, 20.0), st.floats(1e-3, 20.0), st.floats(0.01, 1.0))
def test_equation_11_minimises_its_objective_in_v_over_rho(loss, lambda_u, rho):
    """The closed form is the best v of a grid over [0, rho], with v / rho in the data term too."""
    v = rho * easiness(np.array([loss]), np.array([lambda_u]))[0]
    assert v == pytest.approx(oracle.pspsl_weight(loss, lambda_u, rho), abs=1e-4)


@settings(max_examples=60)
@given(rounds(), AGES, SCOPES)
def test_equation_4_is_the_aged_mean_and_maximum_of_each_group(labels, age, scope):
    """Lambda against plain Python, group by group, NaN if nothing matched."""
    group = {
        "round": np.zeros(len(labels)),
        "category": labels.category,
        "frame": labels.frame_index,
    }[scope]
    expected = oracle.age_parameters(labels.loss, group.tolist(), age.round / age.rounds)
    assert same(age_parameter(labels, age, scope), expected)


@settings(max_examples=60)
@given(rounds(), AGES, SCOPES, st.floats(0.01, 1.0))
def test_a_quantile_can_replace_the_maximum(labels, age, scope, quantile):
    """Lambda with NumPy's own quantile, group by group; never above the maximum."""
    group = {
        "round": np.zeros(len(labels)),
        "category": labels.category,
        "frame": labels.frame_index,
    }[scope]
    expected = np.full(len(labels), np.nan)
    for own in np.unique(group):
        seen = labels.loss[(group == own) & labels.matched]
        if len(seen):
            share = age.round / age.rounds
            hardest = np.quantile(seen, quantile)
            expected[group == own] = share * hardest + (1 - share) * seen.mean()
    assert same(age_parameter(labels, age, scope, quantile), expected)


@settings(max_examples=60)
@given(rounds(), AGES, SCOPES, st.none() | st.floats(0.01, 1.0))
def test_the_invariants_of_the_weights(labels, age, scope, quantile):
    """In [0, 1], PSPSL = rho_det * SPSL, unmatched labels weigh 0, easier never weighs less."""
    spsl = SPSL(scope, quantile).weigh(labels, age)
    pspsl = PSPSL(scope, quantile).weigh(labels, age)
    assert ((spsl.v >= 0) & (spsl.v <= 1)).all()
    assert (spsl.v[~labels.matched] == 0).all()
    assert (pspsl.v <= spsl.v).all()
    assert same(pspsl.v, labels.rho_det * spsl.v)
    assert same(pspsl.lambda_u, spsl.lambda_u)
    for own in np.unique(spsl.lambda_u[labels.matched]):
        k = np.flatnonzero(labels.matched & (spsl.lambda_u == own))
        v = spsl.v[k[np.argsort(labels.loss[k])]]
        assert (np.diff(v) <= 0).all()


def test_the_order_of_the_labels_does_not_matter():
    generator = np.random.default_rng(5)
    n = 50
    loss = np.where(generator.random(n) < 0.2, np.nan, generator.exponential(size=n))
    frames, names = generator.integers(0, 7, n), generator.choice(["Car", "Cyclist"], n)
    rho = generator.random(n)
    order = generator.permutation(n)
    for scope in ("round", "category", "frame"):
        straight = PSPSL(scope).weigh(evidence(loss, [rho], frames, names), Age(1, 2)).v
        shuffled = (
            PSPSL(scope)
            .weigh(evidence(loss[order], [rho[order]], frames[order], names[order]), Age(1, 2))
            .v
        )
        assert shuffled == pytest.approx(straight[order])


def test_worked_example():
    """Losses 1, 2, 3 in round 1 of 2: lambda = (3 + 2) / 2."""
    labels = evidence([1.0, 2.0, 3.0, np.nan], [[0.5, 1.0, 1.0, 1.0], [0.5, 0.5, 1.0, 1.0]])
    assert SPSL().weigh(labels, Age(1, 2)).v == pytest.approx([0.6, 0.2, 0.0, 0.0])
    weights = PSPSL().weigh(labels, Age(1, 2))
    assert weights.v == pytest.approx([0.15, 0.1, 0.0, 0.0])
    assert weights.lambda_u == pytest.approx([2.5] * 4)


def test_no_weight_falls_with_age():
    """Lambda goes from the mean in early rounds to the maximum in the last."""
    labels = evidence([0.2, 1.0, 2.0, 6.0])
    by_round = np.array([SPSL().weigh(labels, Age(e, 4)).v for e in range(1, 5)])
    assert (np.diff(by_round, axis=0) >= 0).all()
    assert (by_round > 0).sum(axis=1).tolist() == [3, 3, 3, 3]
    assert by_round[-1] == pytest.approx([1 - 0.2 / 6, 1 - 1 / 6, 1 - 2 / 6, 0])


@pytest.mark.parametrize("scope", ["round", "category", "frame"])
@pytest.mark.parametrize("age", [Age(1, 3), Age(3, 3)])
def test_losses_that_are_all_zero_give_full_weight(scope, age):
    """Lambda = 0: v = 1 for SPSL, rho_det for PSPSL, and 0 for unmatched labels."""
    labels = evidence([0.0, 0.0, np.nan], [[0.3, 1.0, 1.0]])
    assert SPSL(scope).weigh(labels, age).v.tolist() == [1.0, 1.0, 0.0]
    weights = PSPSL(scope).weigh(labels, age)
    assert weights.v.tolist() == [0.3, 1.0, 0.0]
    assert weights.lambda_u.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("scope", ["round", "category", "frame"])
@pytest.mark.parametrize("quantile", [None, 0.9])
def test_without_any_match_all_weights_are_zero(scope, quantile):
    """All unmatched: v = 0 and no lambda."""
    weights = PSPSL(scope, quantile).weigh(evidence([np.nan, np.nan]), Age(1, 3))
    assert weights.v.tolist() == [0.0, 0.0]
    assert np.isnan(weights.lambda_u).all()


@pytest.mark.parametrize("scope", ["round", "category", "frame"])
@pytest.mark.parametrize("quantile", [None, 0.9])
def test_an_empty_round_has_no_weights(scope, quantile):
    weights = PSPSL(scope, quantile).weigh(evidence([]), Age(1, 3))
    assert weights.v.shape == weights.lambda_u.shape == (0,)


def test_a_group_without_a_match_does_not_affect_the_others():
    """Frame 8 has no evidence, frame 9 has."""
    labels = evidence([np.nan, 1.0, 3.0], frame_index=[8, 9, 9])
    weights = SPSL("frame").weigh(labels, Age(1, 1))
    assert weights.v == pytest.approx([0.0, 2 / 3, 0.0])
    assert np.isnan(weights.lambda_u[0])
    assert weights.lambda_u[1:].tolist() == [3.0, 3.0]


@pytest.mark.parametrize("scope", ["round", "category", "frame"])
@pytest.mark.parametrize("age", [Age(1, 3), Age(2, 3), Age(3, 3), Age(3, 10)])
def test_equal_losses_have_weight_exactly_zero(scope, age):
    """L < lambda fails for all of them, despite rounding of the mean."""
    labels = evidence(
        [0.1] * 3 + [0.7] * 7, category=["a"] * 3 + ["b"] * 7, frame_index=[1] * 3 + [2] * 7
    )
    isolated = evidence([0.1] * 7)
    assert SPSL().weigh(isolated, age).v.tolist() == [0.0] * 7
    if scope != "round":
        assert SPSL(scope).weigh(labels, age).v.tolist() == [0.0] * 10


def test_a_tiny_lambda_does_not_overflow():
    """Denormal losses divide without a warning and stay within [0, 1]."""
    tiny = np.finfo(np.float64).smallest_subnormal
    weights = SPSL().weigh(evidence([0.0, tiny, 1e300]), Age(1, 3))
    assert weights.v.tolist() == [1.0, 1.0, 0.0]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"scope": "batch"}, "batch"), ({"quantile": 0.0}, "quantile"), ({"quantile": 1.1}, "1.1")],
)
@pytest.mark.parametrize("policy", [SPSL, PSPSL])
def test_invalid_settings_are_rejected(policy, wrong, message):
    """The error contains the policy and the setting."""
    with pytest.raises(ConfigError, match=rf"{policy.name}.*{message}"):
        policy(**wrong)


def test_without_the_self_paced_term_only_the_priors_count():
    """The weight is rho_det if a reprediction matched, in every round, and there is no lambda."""
    labels = evidence([0.2, 9.0, np.nan], [[0.5, 0.4, 1.0], [0.5, 1.0, 1.0]])
    for e in (1, 3):
        weights = PSPSL(self_paced=False).weigh(labels, Age(e, 3))
        assert weights.v.tolist() == [0.25, 0.4, 0.0]
        assert np.isnan(weights.lambda_u).all()


def test_without_a_second_pass_every_label_has_its_prior_as_weight():
    """If no label has a loss, there was no second pass; with the self-paced term all weigh 0."""
    labels = evidence([np.nan, np.nan], [[0.5, 0.4], [0.5, 1.0]])
    assert PSPSL(self_paced=False).weigh(labels, Age(1, 3)).v.tolist() == [0.25, 0.4]
    assert PSPSL().weigh(labels, Age(1, 3)).v.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("name", ["rho_diff", "rho_anno"])
def test_each_prior_alone(name):
    """The other one is not used."""
    labels = evidence([0.0, 2.0])
    labels = Evidence(
        labels.frame_index, labels.category, labels.score, labels.loss, {name: np.array([0.5, 1.0])}
    )
    assert PSPSL().weigh(labels, Age(1, 1)).v.tolist() == [0.5, 0.0]


@pytest.mark.parametrize("self_paced", [True, False])
def test_no_label_without_image_evidence_outweighs_the_best_one_with_it(self_paced):
    """It gets at most the same weight; the others keep theirs, and so does the order."""
    labels = replace(
        evidence([0.1, 0.2, 0.3, 0.1], [[0.4, 0.3, 0.9, 0.8]]),
        unseen=np.array([False, False, True, True]),
    )
    policy = PSPSL(self_paced=self_paced)
    plain = policy.weigh(replace(labels, unseen=np.zeros(4, bool)), Age(1, 2)).v
    v = policy.weigh(labels, Age(1, 2)).v
    np.testing.assert_array_equal(v[:2], plain[:2])
    assert plain[2:].max() > plain[:2].max()
    np.testing.assert_array_equal(v[2:], np.minimum(plain[2:], plain[:2].max()))


def test_without_any_weight_on_labels_with_image_evidence_there_is_no_limit():
    """A round in which the camera shows nothing keeps its weights."""
    v = np.array([0.5, 0.3, 0.0])
    np.testing.assert_array_equal(limit_unseen(v, np.array([True, True, False])), v)
    np.testing.assert_array_equal(limit_unseen(v, np.ones(3, bool)), v)
    assert len(limit_unseen(np.zeros(0), np.zeros(0, bool))) == 0
