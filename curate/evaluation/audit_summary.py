"""What an audit means, in plain words, and as plain numbers."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from curate.evaluation.audit import Audit, Comparison, Estimate, Figures
from curate.evaluation.judged_labels import ALL

FEW_FRAMES = 30


def summary_sentences(audit: Audit, policies: Sequence[str], evidence: Sequence[str]) -> list[str]:
    """Sentences: how much is right, who judges best, and whether that is more than chance.

    Args:
        audit: see `Audit`.
        policies: the audited policies that weigh labels for a training.
        evidence: the audited pieces of evidence, judges that no training uses by themselves.
    """
    if not policies:
        policies, evidence = evidence, ()
    by_policy = audit.whole()
    some = next(iter(by_policy.values()))
    sentences = [_share_correct(audit, some), *_left_out(audit, some)]
    ranked = _by_auroc(by_policy, policies)
    if not ranked:
        return [*sentences, *_missing_policies(some)]
    sentences += _best_policy(audit, ranked)
    sentences += _effect_of_evidence(audit, ranked[0], _by_auroc(by_policy, evidence))
    return [*sentences, *_weight_by_correctness([by_policy[name] for name in policies])]


def as_numbers(audit: Audit) -> dict[str, Any]:
    """Plain numbers for JSON; None where a figure is undefined or an edge is open."""
    return {
        "frames": audit.frames,
        "level": audit.level,
        "figures": [_plain(_flat(found)) for found in audit.figures],
        "comparisons": [
            _plain({**asdict(found), "beyond_chance": found.beyond_chance})
            for found in audit.comparisons
        ],
    }


def _flat(found: Figures) -> dict[str, Any]:
    """Return the figures, their bins as rows."""
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
    return {**asdict(found), "bins": rows}


def _plain(value: Any) -> Any:
    """Numbers of numpy as Python's; what is not finite as None."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _share_correct(audit: Audit, some: Figures) -> str:
    place = f"{audit.frames} frames with {some.objects} objects"
    if not some.labels:
        return f"There is no label on {place}, so there is nothing to audit."
    shares = [
        f"{category} {100 * next(iter(whole.values())).share_right.value:.1f} %"
        for category in _categories(audit)
        if next(iter((whole := audit.whole(category)).values())).labels
    ]
    return (
        f"{some.right} of {some.labels} labels are right, {_percent(some.share_right)}, on {place}"
        + (f" ({', '.join(shares)})." if len(shares) > 1 else ".")
    )


def _left_out(audit: Audit, some: Figures) -> Iterator[str]:
    if some.neutral:
        yield (
            f"{some.neutral} more are neither right nor wrong, as they lie on a neighbouring "
            "category (a van, a sitting person) or in a DontCare region."
        )
    if some.labels and audit.frames < FEW_FRAMES:
        yield (
            f"With {audit.frames} frames the intervals are rough themselves; "
            f"{FEW_FRAMES} frames or more would tell more."
        )


def _missing_policies(some: Figures) -> Iterator[str]:
    if some.labels and some.right in (0, some.labels):
        every = "right" if some.right else "wrong"
        yield f"All labels are {every}, so no weight can tell right from wrong here."


def _best_policy(audit: Audit, ranked: Sequence[Figures]) -> Iterator[str]:
    best = ranked[0]
    first = f"Of the policies, {best.policy} judges best: AUROC {_figure(best.auroc)}"
    if len(ranked) == 1:
        yield f"{first.replace('Of the policies, ', '').replace(' judges best', '')}."
        return
    found = audit.compare(best.policy, ranked[1].policy)
    yield f"{first}, before {ranked[1].policy} with {ranked[1].auroc.value:.3f}; {_verdict(found)}."


def _effect_of_evidence(audit: Audit, best: Figures, evidence: Sequence[Figures]) -> Iterator[str]:
    better = [found for found in evidence if found.auroc.value > best.auroc.value]
    if better:
        found = audit.compare(better[0].policy, best.policy)
        yield (
            f"{better[0].policy} alone, without a policy, ranks the labels better than "
            f"{best.policy}: AUROC {_figure(better[0].auroc)}; {_verdict(found)}."
        )


def _weight_by_correctness(policies: Sequence[Figures]) -> Iterator[str]:
    defined = [found for found in policies if not math.isnan(found.weighted_precision.value)]
    order = sorted(defined, key=lambda found: -found.weighted_precision.value)
    if not order:
        return
    shares = ", ".join(
        f"{found.policy} {100 * found.weighted_precision.value:.1f} %" for found in order[1:]
    )
    yield (
        f"Of all the weight that a training would see from {order[0].policy}, "
        f"{_percent(order[0].weighted_precision)} lies on right labels"
        + (f"; {shares}." if shares else ".")
    )


def _verdict(found: Comparison) -> str:
    """Return whether a difference is more than chance."""
    interval = (
        f"{found.difference.value:.3f} ({found.difference.low:.3f} to {found.difference.high:.3f})"
    )
    if found.beyond_chance:
        return f"the difference of {interval} is more than chance"
    return f"the difference of {interval} may be chance, these frames do not tell the two apart"


def _by_auroc(by_policy: dict[str, Figures], names: Sequence[str]) -> list[Figures]:
    """Return the figures of those whose AUROC is defined, the best first."""
    defined = [by_policy[name] for name in names if not math.isnan(by_policy[name].auroc.value)]
    return sorted(defined, key=lambda found: -found.auroc.value)


def _categories(audit: Audit) -> list[str]:
    return [name for name in dict.fromkeys(f.category for f in audit.figures) if name != ALL]


def _figure(estimate: Estimate) -> str:
    return f"{estimate.value:.3f} ({estimate.low:.3f} to {estimate.high:.3f})"


def _percent(estimate: Estimate) -> str:
    value, low, high = (100 * part for part in (estimate.value, estimate.low, estimate.high))
    return f"{value:.1f} % ({low:.1f} to {high:.1f})"
