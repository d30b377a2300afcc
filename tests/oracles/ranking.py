"""AUROC and average precision from their definitions, pair by pair and threshold by threshold."""


def auroc(weights, right):
    """Return the share of (correct, wrong) pairs in which the correct label weighs more.

    Ties count 1/2.
    """
    wins = pairs = 0.0
    for weight, is_right in zip(weights, right, strict=True):
        for other, other_right in zip(weights, right, strict=True):
            if is_right and not other_right:
                pairs += 1
                wins += 1.0 if weight > other else 0.5 if weight == other else 0.0
    return wins / pairs


def average_precision(weights, right):
    """Return the sum, over falling thresholds, of the step in recall times the precision."""
    positives = sum(right)
    total = previous = 0.0
    for threshold in sorted(set(weights), reverse=True):
        kept = [r for w, r in zip(weights, right, strict=True) if w >= threshold]
        recall = sum(kept) / positives
        total += (recall - previous) * sum(kept) / len(kept)
        previous = recall
    return total
