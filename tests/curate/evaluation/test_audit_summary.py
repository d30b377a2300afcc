"""An audit in sentences and as plain numbers."""

import json
from dataclasses import replace

import numpy as np
from support.audited import many_labels, six_labels, small_audit

from curate.evaluation.audit import audit
from curate.evaluation.audit_summary import as_numbers, summary_sentences
from curate.evaluation.evaluated_labels import EvaluatedLabels


def words(labels, weights, policies, evidence=()):
    """Return all sentences as one text."""
    found = audit(labels, weights, ("Car", "Cyclist"), np.random.default_rng(0), replicates=200)
    return " ".join(summary_sentences(found, policies, evidence))


def test_it_describes_the_correct_labels_and_the_neutral_ones():
    """In total and by category, with a warning for few frames."""
    text = " ".join(summary_sentences(small_audit(), ("good", "bad", "all"), ()))
    assert text.startswith("2 of 5 labels are correct, 40.0 % (")
    assert "on 3 frames with 5 objects (Car 50.0 %, Cyclist 0.0 %)" in text
    assert "1 more are neither correct nor wrong" in text
    assert "With 3 frames the intervals are only approximate" in text


def test_it_describes_the_best_policy_and_the_next():
    """With the difference, and whether it may be chance."""
    labels, weights = many_labels()
    text = words(labels, weights, ("blind", "good"))
    assert "Of the policies, good ranks the labels best: AUROC 1.000" in text
    assert "Next is blind with 0.5" in text
    assert "is significant" in text
    weights["as blind"] = np.random.default_rng(4).random(len(labels))
    assert "is not significant" in words(labels, weights, ("blind", "as blind"))


def test_it_describes_where_the_weight_is():
    """The best policy by that measure first, with the share of each."""
    text = " ".join(summary_sentences(small_audit(), ("all", "good"), ()))
    assert "that good gives, 89.5 %" in text
    assert text.endswith("is on correct labels; all 40.0 %.")


def test_it_describes_the_best_at_equal_recall():
    """Against the reference, whose recall is named; against the next if it is the best itself."""
    text = " ".join(summary_sentences(small_audit(reference="all"), ("all", "good"), ()))
    assert "At the weighted recall of all (0.400), good has the greatest share" in text
    assert "all has 40.0 %; the difference of" in text
    text = " ".join(summary_sentences(small_audit(), ("all", "good"), ()))
    assert "At the weighted recall of good (0.340), good has the greatest share" in text
    assert "all has 40.0 %" in text


def test_a_difference_that_may_be_chance_is_called_so():
    """Two random weights."""
    labels, weights = many_labels()
    weights["as blind"] = np.random.default_rng(4).random(len(labels))
    assert "may be chance" in words(labels, weights, ("blind", "as blind"))


def test_it_describes_which_weights_are_calibrated():
    """With the error that chance explains; the others are named."""
    labels, _ = many_labels()
    generator = np.random.default_rng(2)
    p = generator.random(len(labels))
    labels.correct[:] = generator.random(len(labels)) < p
    text = words(labels, {"p": p, "all": np.ones(len(p))}, ("p", "all"))
    assert "The calibration error of p, 0.0" in text
    assert "may be chance: that of perfectly calibrated weights would be 0.0" in text
    assert "larger than chance explains for all." in text


def test_few_sequences_are_described():
    """Every difference may be chance; the other caveat counts sequences too."""
    labels, weights = many_labels()
    sequence = np.array([f"drive {frame % 4}" for frame in range(labels.frames)])
    text = words(replace(labels, sequence=sequence), weights, ("good", "blind"))
    assert "With 4 sequences the intervals are only approximate" in text
    assert "there are fewer than 6 sequences (4): every difference may be chance" in text
    assert "is significant" not in text


def test_evidence_better_than_every_policy_is_described():
    """With its difference; worse evidence is not mentioned."""
    labels, weights = many_labels()
    text = words(labels, weights, ("fair",), ("good", "blind"))
    assert "good alone, without a policy, ranks the labels better than fair" in text
    assert "blind alone" not in text
    assert "fair: AUROC" in text


def test_evidence_without_a_policy_is_evaluated_too():
    """As if each piece were a policy."""
    assert "good ranks the labels best" in words(*many_labels(), (), ("good", "blind"))


def test_undefined_comparisons_are_described():
    """All labels wrong, and no labels at all."""
    wrong = six_labels()
    wrong.correct[:] = False
    text = words(wrong, {"all": np.ones(6)}, ("all",))
    assert "All labels are wrong, so the AUROC is undefined" in text
    nothing = words(EvaluatedLabels.no_frames(), {"all": np.zeros(0)}, ("all",))
    assert (
        nothing == "There are no labels on 0 frames with 0 objects, so there is nothing to audit."
    )


def test_the_numbers_are_strict_json():
    """No NaN and no infinity: null if a value is undefined or an edge is open."""
    numbers = as_numbers(small_audit())
    text = json.dumps(numbers, allow_nan=False)
    assert json.loads(text) == numbers
    first = numbers["figures"][0]
    assert first["slice"] == {"by": "all", "low": 0, "high": None}
    assert first["auroc"]["value"] == 1
    assert [each["labels"] for each in first["bins"]] == [2, 1, 0, 0, 0, 0, 0, 0, 1, 1]
    assert first["bins"][5]["precision"] is None
    assert numbers["comparisons"][0]["beyond_chance"] is True
    found = numbers["comparisons"][0]["differences"]["equal_recall_precision"]
    assert found["low"] <= 0 < found["value"]  # both are 1 if only frame 0 is drawn
    assert found["beyond_chance"] is False
    assert (numbers["reference"], numbers["sequences"]) == ("good", None)
    assert first["calibrated"] in (True, False)
