"""A bootstrap over frames in which the labels are sorted once, not once per draw.

A draw of frames with replacement is kept as how often each frame was drawn. Every figure is then a
sum over labels with these multiplicities.
"""

import numpy as np
from numba import njit

from curate.shapes import Bool, Float, Int

_BLOCK = 256  # draws whose sums stay in the fastest cache


def draw_frames(
    generator: np.random.Generator, frames: int, replicates: int
) -> Float[np.ndarray, "r f"]:
    """Return (r, f) float64, how often each of f frames is among f that are drawn with replacement.

    A frame's column lies in one piece, as `ranked_replicates` reads it.
    """
    if frames == 0:
        return np.zeros((replicates, 0))
    drawn: np.ndarray = generator.multinomial(frames, np.full(frames, 1 / frames), replicates)
    return drawn.astype(np.float64, order="F")


def ranked_replicates(
    weights: Float[np.ndarray, " n"],
    right: Bool[np.ndarray, " n"],
    frame_index: Int[np.ndarray, " n"],
    draws: Float[np.ndarray, "r f"],
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, " r"]]:
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
    by_frame = np.ascontiguousarray(draws.T)
    found, area = np.empty(len(draws)), np.empty(len(draws))
    for start in range(0, len(draws), _BLOCK):
        block = slice(start, start + _BLOCK)
        columns = frame_index[order], right[order], ends
        found[block], area[block] = _rank(by_frame[:, block], *columns)
    return found, area


@njit(cache=True, nogil=True, error_model="numpy")
def _rank(
    draws: np.ndarray, frame_index: np.ndarray, right: np.ndarray, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """AUROC and average precision of labels by falling weight, of a block of draws (f, b).

    `ends` marks the last label of each group of equal weights: such labels count as one step. The
    innermost loop runs over the draws, so that it becomes vector instructions.
    """
    count = draws.shape[1]
    own_right, own_wrong, wins, area = np.zeros((4, count))
    heavier_right, heavier = np.zeros((2, count))
    has_right = has_wrong = False
    for i in range(len(frame_index)):
        times = draws[frame_index[i]]
        if right[i]:
            has_right = True
            for b in range(count):
                own_right[b] += times[b]
        else:
            has_wrong = True
            for b in range(count):
                own_wrong[b] += times[b]
        if ends[i] and has_wrong:
            for b in range(count):
                wins[b] += own_wrong[b] * (heavier_right[b] + own_right[b] / 2)
                heavier[b] += own_wrong[b]
                own_wrong[b] = 0.0
        if ends[i] and has_right:
            for b in range(count):
                heavier_right[b] += own_right[b]
                heavier[b] += own_right[b]
                # Nothing drawn so far is nothing found: 0 / 1 in place of 0 / 0.
                area[b] += own_right[b] * heavier_right[b] / max(heavier[b], 1.0)
                own_right[b] = 0.0
        if ends[i]:
            has_right = has_wrong = False
    # Without a pair, or without a right label, 0 / 0 is NaN.
    return wins / (heavier_right * (heavier - heavier_right)), area / heavier_right
