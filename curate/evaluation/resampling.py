"""A bootstrap over frames in which the labels are sorted once, not once per draw.

A draw of frames with replacement is kept as how often each frame was drawn. Every figure is then a
sum over labels with these multiplicities. `curate.evaluation.reliability.bootstrap` does the same
for any statistic, by copying labels and a hundred times slower.
"""

import numpy as np
from numba import njit


def draw_frames(generator: np.random.Generator, frames: int, replicates: int) -> np.ndarray:
    """(r, f) float64, how often each of f frames is among f that are drawn with replacement."""
    if frames == 0:
        return np.zeros((replicates, 0))
    drawn: np.ndarray = generator.multinomial(frames, np.full(frames, 1 / frames), replicates)
    return drawn.astype(np.float64)


def ranked_replicates(
    weights: np.ndarray, right: np.ndarray, frame_index: np.ndarray, draws: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """AUROC and average precision of the weight in every draw, NaN where undefined.

    Args:
        weights: (n,) of the labels.
        right: (n,) bool.
        frame_index: (n,) integer in [0, f).
        draws: (r, f), see `draw_frames`.

    Returns:
        (r,) and (r,).
    """
    order = np.argsort(-weights, kind="stable")
    ends = np.append(np.diff(weights[order]) != 0, True)[: len(order)]
    figures = _rank(draws, frame_index[order], right[order], ends)
    return figures[:, 0], figures[:, 1]


@njit(cache=True, nogil=True)
def _rank(
    draws: np.ndarray, frame_index: np.ndarray, right: np.ndarray, ends: np.ndarray
) -> np.ndarray:
    """(r, 2) AUROC and average precision of labels by falling weight.

    `ends` marks the last label of each group of equal weights: such labels count as one step.
    """
    figures = np.empty((len(draws), 2))
    for replicate in range(len(draws)):
        heavier_right = heavier_wrong = own_right = own_wrong = wins = area = 0.0
        for i in range(len(frame_index)):
            times = draws[replicate, frame_index[i]]
            if right[i]:
                own_right += times
            else:
                own_wrong += times
            if ends[i]:
                wins += own_wrong * (heavier_right + own_right / 2)
                heavier_right += own_right
                heavier_wrong += own_wrong
                if own_right > 0:
                    area += own_right * heavier_right / (heavier_right + heavier_wrong)
                own_right = own_wrong = 0.0
        pairs = heavier_right * heavier_wrong
        figures[replicate, 0] = wins / pairs if pairs > 0 else np.nan
        figures[replicate, 1] = area / heavier_right if heavier_right > 0 else np.nan
    return figures
