"""AUROC and average precision from their definitions, pair by pair and threshold by threshold."""


def auroc(weights, right):
    """Share of (right, wrong) pairs in which the right label weighs more; ties count half."""
    wins = pairs = 0.0
    for weight, is_right in zip(weights, right, strict=True):
        for other, other_right in zip(weights, right, strict=True):
            if is_right and not other_right:
                pairs += 1
                wins += 1.0 if weight > other else 0.5 if weight == other else 0.0
    return wins / pairs


def average_precision(weights, right):
    """Sum over the thresholds, from high to low, of the step in recall times the precision."""
    positives = sum(right)
    total = previous = 0.0
    for threshold in sorted(set(weights), reverse=True):
        kept = [r for w, r in zip(weights, right, strict=True) if w >= threshold]
        recall = sum(kept) / positives
        total += (recall - previous) * sum(kept) / len(kept)
        previous = recall
    return total
