"""The best one-to-one assignment by trying all of them."""

from itertools import combinations, permutations


def best_total(gains):
    """Return the largest sum of gains over one-to-one pairs of rows and columns."""
    rows, columns = len(gains), len(gains[0]) if len(gains) else 0
    best = 0.0
    for size in range(1, min(rows, columns) + 1):
        for chosen in combinations(range(rows), size):
            for others in permutations(range(columns), size):
                total = sum(gains[r][c] for r, c in zip(chosen, others, strict=True))
                best = max(best, total)
    return best
