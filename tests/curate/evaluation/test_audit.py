"""The numbers of an audit, against values by hand and the functions that compute them."""

from dataclasses import replace

import numpy as np
import pytest
from support.audited import WEIGHTS, many_labels, six_labels, small_audit

from curate.detections import as_categories
from curate.evaluation.audit import COMPARED, Estimate, audit
from curate.evaluation.evaluated_labels import EvaluatedLabels


def part(found, policy, category, name):
    """Return the numbers of a policy, category and slice."""
    return next(
        each
        for each in found.figures
        if (each.policy, each.category) == (policy, category) and f"{each.slice}" == name
    )


def test_the_numbers_by_hand():
    """Correct: 0.9, 0.8. Wrong: 0.15, 0.05, 0. The neutral label of 0.5 is left out."""
    good = small_audit().whole()["good"]
    assert (good.labels, good.neutral, good.right, good.objects) == (5, 1, 2, 5)
    assert good.share_right.value == 2 / 5
    assert good.auroc.value == good.average_precision.value == 1
    assert good.weighted_precision.value == pytest.approx(1.7 / 1.9)
    assert good.weighted_recall.value == pytest.approx(1.7 / 5)
    # Alone in their bins: |1 - 0.9|, |1 - 0.8|, |0 - 0.15|; together in the first: |0 - 0.025| * 2.
    error = (0.1 + 0.2 + 0.15 + 2 * 0.025) / 5
    assert good.calibration_error.value == pytest.approx(error)
    assert good.bins.labels.tolist() == [2, 1, 0, 0, 0, 0, 0, 0, 1, 1]
    assert good.bins.precision[[0, 1, 8, 9]].tolist() == [0, 0, 1, 1]
    assert good.bins.recall[[0, 8, 9]].tolist() == [0, 1 / 5, 1 / 5]


def test_a_weighting_that_is_always_wrong():
    """Wrong labels weigh more than correct ones: precision 1/4 and 2/5 at the correct ones."""
    bad = small_audit().whole()["bad"]
    assert bad.auroc.value == 0
    assert bad.average_precision.value == pytest.approx((1 / 4 + 2 / 5) / 2)
    assert bad.weighted_precision.value == pytest.approx(0.3 / 3.1)


def test_categories_are_evaluated_separately():
    """The cyclist's only label is wrong, so the AUROC is undefined; its object is missed."""
    found = small_audit()
    car, cyclist = found.whole("Car")["good"], found.whole("Cyclist")["good"]
    assert (car.labels, car.neutral, car.right, car.objects) == (4, 1, 2, 4)
    assert (cyclist.labels, cyclist.right, cyclist.objects) == (1, 0, 1)
    assert cyclist.share_right.value == 0
    assert np.isnan(cyclist.auroc.value)
    assert np.isnan(cyclist.auroc.low)


def test_labels_are_broken_down_by_distance_and_points():
    """Each label is in one range of each; objects have a distance, but no number of points."""
    found = small_audit()
    near = part(found, "good", "all", "0-20 m")
    assert (near.labels, near.neutral, near.right, near.objects) == (2, 1, 1, 3)
    middle = part(found, "good", "all", "20-40 m")
    assert (middle.labels, middle.right, middle.objects) == (2, 1, 1)
    assert middle.auroc.value == 1
    few = part(found, "good", "all", "0-10")
    assert (few.labels, few.right, few.objects) == (2, 1, None)
    assert np.isnan(few.weighted_recall.value)
    for kind in ("distance", "points"):
        parts = [
            each
            for each in found.figures
            if (each.slice.by, each.policy, each.category) == (kind, "all", "all")
        ]
        assert sum(each.labels for each in parts) == 5


def test_every_two_policies_are_compared_in_both_directions():
    """The good policy exceeds the bad one by 1 in every draw in which both are defined."""
    found = small_audit()
    compared = found.compare("good", "bad")
    assert (compared.difference.value, compared.difference.low, compared.difference.high) == (
        1,
    ) * 3
    assert compared.beyond_chance
    turned = found.compare("bad", "good")
    assert (turned.policy, turned.difference.value, turned.difference.low) == ("bad", -1, -1)
    assert turned.beyond_chance
    assert len([each for each in found.comparisons if each.category == "all"]) == 3


def test_intervals_contain_the_value_and_shrink_with_more_frames():
    """Four times the frames, about half the width."""
    few, many = (audit_of(*many_labels(frames)).whole()["fair"] for frames in (50, 200))
    for name in ("share_right", "auroc", "average_precision", "weighted_precision"):
        narrow, wide = getattr(many, name), getattr(few, name)
        assert wide.low < wide.value < wide.high
        assert narrow.high - narrow.low < 0.7 * (wide.high - wide.low)


def test_a_significant_difference_is_distinguished_from_chance():
    """A good policy beats a random one; two random ones do not differ."""
    labels, weights = many_labels()
    weights["blind too"] = np.random.default_rng(9).random(len(labels))
    found = audit_of(labels, weights)
    assert found.compare("good", "blind").beyond_chance
    assert found.compare("fair", "blind").beyond_chance
    assert not found.compare("blind", "blind too").beyond_chance
    assert abs(found.whole()["blind"].auroc.value - 0.5) < 0.1


def test_the_coverage_of_the_interval_is_about_its_level():
    """AUROC is known, 80 % intervals of 60 datasets: between 65 and 95 % contain it.

    Correct labels weigh u, wrong ones u * u' for uniform u, u': P(u > u'' u') = 3/4.
    """
    hits = 0
    for seed in range(60):
        labels, _ = many_labels(frames=50, seed=seed)
        u = np.random.default_rng(1000 + seed).random((2, len(labels)))
        weights = np.where(labels.correct, u[0], u[0] * u[1])
        found = audit(
            labels, {"judge": weights}, (), np.random.default_rng(seed), replicates=200, level=0.8
        ).whole()["judge"]
        hits += found.auroc.low <= 0.75 <= found.auroc.high
    assert 0.65 * 60 <= hits <= 0.95 * 60


def test_the_same_seed_gives_the_same_audit():
    """To the last bit; another seed gives the same values with other intervals."""
    labels, weights = many_labels()
    one, same = audit_of(labels, weights), audit_of(labels, weights)
    assert [each.auroc for each in one.figures] == [each.auroc for each in same.figures]
    other = audit(labels, weights, ("Car",), np.random.default_rng(7), replicates=200)
    assert one.whole()["good"].auroc.value == other.whole()["good"].auroc.value
    assert one.whole()["good"].weighted_recall.low != other.whole()["good"].weighted_recall.low


def test_the_order_of_frames_does_not_change_the_numbers():
    """Frames renumbered backwards."""
    labels = six_labels()
    turned = EvaluatedLabels(
        **{
            **vars(labels),
            "frame_index": 2 - labels.frame_index,
            "object_frame": 2 - labels.object_frame,
        }
    )
    for one, other in zip(small_audit().figures, small_audit(labels=turned).figures, strict=True):
        for name in ("share_right", "auroc", "weighted_recall", "calibration_error"):
            values = getattr(one, name).value, getattr(other, name).value
            assert values[0] == pytest.approx(values[1], nan_ok=True)


def test_no_labels_and_no_objects_do_not_fail():
    """Counts of 0, and values that are undefined."""
    nothing = EvaluatedLabels.no_frames()
    found = small_audit({name: np.zeros(0) for name in WEIGHTS}, nothing).whole()["good"]
    assert (found.labels, found.right, found.objects) == (0, 0, 0)
    for name in ("share_right", "auroc", "weighted_precision", "weighted_recall"):
        assert np.isnan(getattr(found, name).value)


def test_precision_at_equal_recall_by_hand():
    """The reference has 1.7 on correct labels. All weights are 1 for "all": 2 of 5 are correct."""
    found = small_audit()
    assert found.reference == "good"
    whole = found.whole()
    assert whole["good"].equal_recall_power == pytest.approx(1)
    assert whole["good"].equal_recall_precision.value == pytest.approx(1.7 / 1.9)
    assert whole["all"].equal_recall_power == np.inf
    assert whole["all"].equal_recall_precision.value == pytest.approx(2 / 5)
    # 0.05^g + 0.25^g = 1.7 at a small g, where the wrong labels have almost weight 1.
    power = whole["bad"].equal_recall_power
    assert 0.05**power + 0.25**power == pytest.approx(1.7)
    rest = 0.85**power + 0.95**power + 1
    assert whole["bad"].equal_recall_precision.value == pytest.approx(1.7 / (1.7 + rest))
    near = part(found, "all", "all", "0-20 m")
    assert near.equal_recall_precision.value == pytest.approx(1 / 2)


def test_a_figure_that_cannot_be_computed_has_no_interval():
    """Even if some draws have it, such as a recall that is within reach in some draws only."""
    found = Estimate.of(np.nan, np.array([0.4, np.nan, 0.6]), 0.95)
    assert np.isnan([found.value, found.low, found.high]).all()


def test_the_reference_can_be_chosen_and_has_to_give_weight():
    """Weights of 0 and weights that were not measured cannot be the reference."""
    assert small_audit(reference="bad").reference == "bad"
    no_weight = {"none": np.zeros(6), "lost": np.full(6, np.nan)}
    found = small_audit({**no_weight, "all": np.ones(6)}, reference="lost")
    assert found.reference == "all"
    assert np.isnan(found.whole()["none"].equal_recall_precision.value)
    assert small_audit(no_weight).reference is None


def test_calibrated_weights_are_within_chance_and_others_beyond():
    """Correct with a probability of v, of v^3, and with all weights 1."""
    labels, _ = many_labels()
    generator = np.random.default_rng(2)
    v = generator.random(len(labels))
    labels.correct[:] = generator.random(len(labels)) < v
    whole = audit_of(labels, {"p": v, "bold": np.cbrt(v), "one": np.ones(len(v))}).whole()
    assert whole["p"].calibrated
    assert whole["p"].calibration_error_by_chance < whole["p"].calibration_error_limit
    assert not whole["bold"].calibrated
    assert not whole["one"].calibrated
    assert whole["one"].calibration_error_limit == 0


def test_every_figure_of_two_policies_is_compared():
    """The better policy is better in each; a copy of it has no difference at all."""
    labels, weights = many_labels()
    found = audit_of(labels, {**weights, "copy": weights["fair"].copy()})
    better, same = found.compare("fair", "blind"), found.compare("fair", "copy")
    for name in COMPARED:
        one, other = (getattr(found.whole()[policy], name).value for policy in ("fair", "blind"))
        assert better.differences[name].value == pytest.approx(one - other)
        assert (same.differences[name].low, same.differences[name].high) == (0, 0)
        assert not same.is_real(name)
    for name in ("auroc", "average_precision", "equal_recall_precision"):
        assert better.is_real(name)
        assert better.negated().differences[name].high == -better.differences[name].low


def test_chance_is_called_real_about_as_often_as_the_level_says():
    """Two policies that differ by noise only, 95 % intervals of 60 data sets: at most 8 real."""
    real = dict.fromkeys(COMPARED, 0)
    for seed in range(60):
        labels, _ = many_labels(frames=40, seed=seed)
        noise = np.random.default_rng(500 + seed).random((2, len(labels)))
        weights = {str(i): np.clip(0.3 * labels.correct + 0.7 * noise[i], 0, 1) for i in (0, 1)}
        found = audit(labels, weights, (), np.random.default_rng(seed), replicates=200)
        compared = found.compare("0", "1")
        for name in COMPARED:
            real[name] += compared.is_real(name)
    assert max(real.values()) <= 8
    assert sum(real.values()) > 0


def in_sequences(labels, count):
    """Return the labels with each run of frames in a sequence."""
    names = [f"drive {frame * count // labels.frames}" for frame in range(labels.frames)]
    return replace(labels, sequence=as_categories(names))


def test_frames_of_a_sequence_are_resampled_together():
    """Sequences of copies of one frame have the wider interval of the frames that were copied."""
    labels, weights = many_labels(frames=12)
    copies = np.tile(np.arange(len(labels)), 5)
    copied = replace(
        labels,
        frames=60,
        **{
            name: getattr(labels, name)[copies]
            for name in ("category", "distance", "points", "correct", "counted", "neutral")
        },
        **{name: getattr(labels, name)[copies] for name in ("object_category", "object_distance")},
        frame_index=labels.frame_index[copies] + 12 * np.repeat(np.arange(5), len(labels)),
        object_frame=labels.object_frame[copies] + 12 * np.repeat(np.arange(5), len(labels)),
        sequence=as_categories([f"drive {frame % 12:02d}" for frame in range(60)]),
    )
    many = {name: v[copies] for name, v in weights.items()}
    once, together = audit_of(labels, weights), audit_of(copied, many)
    alone = audit_of(replace(copied, sequence=as_categories([""] * 60)), many)
    assert (once.sequences, together.sequences, alone.sequences) == (None, 12, None)
    assert (together.resampled, alone.resampled) == ("12 sequences", "60 frames")
    for name in ("auroc", "weighted_precision", "equal_recall_precision", "calibration_error"):
        one, same, narrow = (getattr(found.whole()["fair"], name) for found in
                             (once, together, alone))  # fmt: skip
        assert (same.low, same.high) == pytest.approx((one.low, one.high))
        assert narrow.high - narrow.low < 0.7 * (same.high - same.low)


def test_few_sequences_cannot_show_that_a_difference_is_real():
    """Five sequences that all favour one policy are chance in 6 % of cases."""
    labels, weights = many_labels()
    for count, real in ((5, False), (6, True)):
        found = audit_of(in_sequences(labels, count), weights)
        assert found.sequences == count
        assert found.compare("good", "blind").beyond_chance is real
    single = audit_of(in_sequences(labels, 1), weights)
    assert (single.sequences, single.resampled) == (1, "60 frames")
    assert not single.compare("good", "blind").beyond_chance


def audit_of(labels, weights):
    """Return the audit of many labels."""
    return audit(labels, weights, ("Car",), np.random.default_rng(0), replicates=200)
