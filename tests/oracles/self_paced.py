"""The self-paced weights by brute force: the objective's minimum over a fine grid of weights."""

import numpy as np

GRID = np.linspace(0.0, 1.0, 10_001)


def spsl_weight(loss, lambda_u):
    """Return the v in [0, 1] with the least v L + lambda (v^2 / 2 - v), to 1e-4."""
    return GRID[np.argmin(GRID * loss + lambda_u * (GRID**2 / 2 - GRID))]


def pspsl_weight(loss, lambda_u, rho):
    """Return the v in [0, rho] with the least r L + lambda (r^2 / 2 - r), r = v / rho, to 1e-4."""
    v = GRID * rho
    share = v / rho
    return v[np.argmin(share * loss + lambda_u * (share**2 / 2 - share))]


def age_parameters(losses, groups, share):
    """Return lambda of each label, group by group in plain Python; None if no label matched."""
    lambdas = []
    for own in groups:
        seen = [
            loss
            for loss, group in zip(losses, groups, strict=True)
            if group == own and not np.isnan(loss)
        ]
        mean = sum(seen) / len(seen) if seen else None
        lambdas.append(share * max(seen) + (1 - share) * mean if seen else None)
    return lambdas
