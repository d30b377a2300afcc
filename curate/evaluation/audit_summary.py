"""Summarise an audit in sentences, or as plain numbers."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from curate.evaluation.audit import FEWEST_SEQUENCES, Audit, Comparison, Estimate, Figures
from curate.evaluation.evaluated_labels import ALL

FEW_FRAMES = 30


def summary_sentences(audit: Audit, policies: Sequence[str], evidence: Sequence[str]) -> list[str]:
    """Return sentences: share of correct labels, best policy, and whether the lead is significant.

    Args:
        audit: see `Audit`.
        policies: the audited policies, which weight labels for training.
        evidence: the audited columns of evidence, which no training uses as weights directly.
    """
    if not policies:
        policies, evidence = evidence, ()
    by_policy = audit.whole()
    some = next(iter(by_policy.values()))
    sentences = [_share_correct(audit, some), *_caveats(audit, some)]
    ranked = _by_auroc(by_policy, policies)
    if not ranked:
        return [*sentences, *_undefined_auroc(some)]
    sentences += _best_policy(audit, ranked)
    sentences += _effect_of_evidence(audit, ranked[0], _by_auroc(by_policy, evidence))
    everything = [by_policy[name] for name in (*policies, *evidence)]
    sentences += [*_at_equal_recall(audit, everything), *_calibration(everything)]
    return [*sentences, *_weight_by_correctness([by_policy[name] for name in policies])]


def as_numbers(audit: Audit) -> dict[str, Any]:
    """Return plain numbers for JSON; None for an undefined figure or an open upper edge."""
    return {
        "frames": audit.frames,
        "sequences": audit.sequences,
        "reference": audit.reference,
        "level": audit.level,
        "counts": {"objects": audit.counts.as_dict(), "labels": audit.label_counts.as_dict()},
        "figures": [as_plain(_flat(found)) for found in audit.figures],
        "comparisons": [as_plain(_compared(found)) for found in audit.comparisons],
    }


def _compared(found: Comparison) -> dict[str, Any]:
    """Return a comparison as a dictionary, with what is real among its differences."""
    return {
        "category": found.category,
        "policy": found.policy,
        "other": found.other,
        "difference": asdict(found.difference),
        "beyond_chance": found.beyond_chance,
        "differences": {
            name: {**asdict(difference), "beyond_chance": found.is_real(name)}
            for name, difference in found.differences.items()
        },
    }


def _flat(found: Figures) -> dict[str, Any]:
    """Return the figures as a dictionary, with one row per bin."""
    bins = found.bins
    rows = [
        {
            "low": low,
            "high": high,
            "labels": labels,
            "mean_weight": weight,
            "precision": precision,
            "recall": recall,
        }
        for low, high, labels, weight, precision, recall in zip(
            *(bins.edges[:-1], bins.edges[1:], bins.labels),
            *(bins.mean_weight, bins.precision, bins.recall),
            strict=True,
        )
    ]
    undefined = math.isnan(found.calibration_error.value)
    return {**asdict(found), "calibrated": None if undefined else found.calibrated, "bins": rows}


def as_plain(value: Any) -> Any:
    """Convert numpy numbers to Python's, and NaN and infinity to None."""
    if isinstance(value, dict):
        return {key: as_plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [as_plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _share_correct(audit: Audit, some: Figures) -> str:
    place = f"{audit.frames} frames with {some.objects} objects"
    if not some.labels:
        return f"There are no labels on {place}, so there is nothing to audit."
    shares = [
        f"{category} {100 * next(iter(whole.values())).share_right.value:.1f} %"
        for category in _categories(audit)
        if next(iter((whole := audit.whole(category)).values())).labels
    ]
    return (
        f"{some.right} of {some.labels} labels are correct, "
        f"{_percent(some.share_right)}, on {place}"
        + (f" ({', '.join(shares)})." if len(shares) > 1 else ".")
    )


def _caveats(audit: Audit, some: Figures) -> Iterator[str]:
    if some.neutral:
        yield (
            f"{some.neutral} more are neither correct nor wrong, because they lie on an object of "
            "a neighbour category (Van, Person_sitting) or in a DontCare region."
        )
    count, units = audit.resampled.split()
    if some.labels and int(count) < FEW_FRAMES:
        yield (
            f"With {count} {units} the intervals are only approximate; "
            f"use {FEW_FRAMES} {units} or more."
        )
    if some.labels and not audit.conclusive:
        yield (
            f"Frames of one sequence are alike, and there are fewer than {FEWEST_SEQUENCES} "
            f"sequences ({audit.sequences}): every difference may be chance."
        )


def _undefined_auroc(some: Figures) -> Iterator[str]:
    if some.labels and some.right in (0, some.labels):
        every = "correct" if some.right else "wrong"
        yield f"All labels are {every}, so the AUROC is undefined here."


def _best_policy(audit: Audit, ranked: Sequence[Figures]) -> Iterator[str]:
    best = ranked[0]
    if len(ranked) == 1:
        yield f"{best.policy}: AUROC {_figure(best.auroc)}."
        return
    second = ranked[1]
    yield (
        f"Of the policies, {best.policy} ranks the labels best: AUROC {_figure(best.auroc)}. "
        f"Next is {second.policy} with {second.auroc.value:.3f}; "
        f"{_significance(audit.compare(best.policy, second.policy))}."
    )


def _effect_of_evidence(audit: Audit, best: Figures, evidence: Sequence[Figures]) -> Iterator[str]:
    better = [found for found in evidence if found.auroc.value > best.auroc.value]
    if better:
        found = audit.compare(better[0].policy, best.policy)
        yield (
            f"{better[0].policy} alone, without a policy, ranks the labels better than "
            f"{best.policy}: AUROC {_figure(better[0].auroc)}; {_significance(found)}."
        )


def _at_equal_recall(audit: Audit, found: Sequence[Figures]) -> Iterator[str]:
    """Yield the best policy or evidence at equal weighted recall, against the reference."""
    defined = [each for each in found if not math.isnan(each.equal_recall_precision.value)]
    order = sorted(defined, key=lambda each: -each.equal_recall_precision.value)
    if audit.reference is None or len(order) < 2:
        return
    best, reference = order[0], audit.whole()[audit.reference]
    other = order[1] if best is reference else reference
    difference = _significance(audit.compare(best.policy, other.policy), "equal_recall_precision")
    yield (
        f"At the weighted recall of {reference.policy} ({reference.weighted_recall.value:.3f}), "
        f"{best.policy} has the greatest share of its weight on correct labels: "
        f"{_percent(best.equal_recall_precision)}. {other.policy} has "
        f"{100 * other.equal_recall_precision.value:.1f} %; {difference}."
    )


def _calibration(found: Sequence[Figures]) -> Iterator[str]:
    """Yield which weights are probabilities as far as these labels can show."""
    defined = [each for each in found if not math.isnan(each.calibration_error.value)]
    beyond = [each.policy for each in defined if not each.calibrated]
    for each in defined:
        if each.calibrated:
            yield (
                f"The calibration error of {each.policy}, {each.calibration_error.value:.3f}, may "
                "be chance: that of perfectly calibrated weights would be "
                f"{each.calibration_error_by_chance:.3f}, up to {each.calibration_error_limit:.3f}."
            )
    if beyond:
        yield f"The calibration error is larger than chance explains for {', '.join(beyond)}."


def _weight_by_correctness(policies: Sequence[Figures]) -> Iterator[str]:
    defined = [found for found in policies if not math.isnan(found.weighted_precision.value)]
    order = sorted(defined, key=lambda found: -found.weighted_precision.value)
    if not order:
        return
    shares = ", ".join(
        f"{found.policy} {100 * found.weighted_precision.value:.1f} %" for found in order[1:]
    )
    yield (
        f"Of the total weight that {order[0].policy} gives, "
        f"{_percent(order[0].weighted_precision)} is on correct labels"
        + (f"; {shares}." if shares else ".")
    )


def _significance(found: Comparison, figure: str = "auroc") -> str:
    interval = f"the difference of {_figure(found.differences[figure])}"
    if found.is_real(figure):
        return f"{interval} is significant"
    return f"{interval} is not significant on these frames and may be chance"


def _by_auroc(by_policy: dict[str, Figures], names: Sequence[str]) -> list[Figures]:
    """Return the figures with a defined AUROC, the best first."""
    defined = [by_policy[name] for name in names if not math.isnan(by_policy[name].auroc.value)]
    return sorted(defined, key=lambda found: -found.auroc.value)


def _categories(audit: Audit) -> list[str]:
    return [name for name in dict.fromkeys(f.category for f in audit.figures) if name != ALL]


def _figure(estimate: Estimate) -> str:
    return f"{estimate.value:.3f} ({estimate.low:.3f} to {estimate.high:.3f})"


def _percent(estimate: Estimate) -> str:
    value, low, high = (100 * part for part in (estimate.value, estimate.low, estimate.high))
    return f"{value:.1f} % ({low:.1f} to {high:.1f})"
