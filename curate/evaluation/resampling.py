"""A bootstrap over frames that sorts the labels once, not once per draw.

A draw of frames with replacement is stored as the number of times that each frame was drawn. Every
figure is then a sum over labels, each counted as often as its frame was drawn.
"""

import numpy as np
from numba import njit

from curate.shapes import Bool, Float, Int

_BLOCK = 256  # the sums of so many draws fit into the L1 cache


def draw_frames(
    generator: np.random.Generator, frames: int, replicates: int
) -> Float[np.ndarray, "r f"]:
    """Draw f of f frames with replacement, r times; return (r, f) float64 counts of each frame.

    The array is stored column by column, because `ranked_replicates` reads it by frame.
    """
    if frames == 0:
        return np.zeros((replicates, 0))
    drawn: np.ndarray = generator.multinomial(frames, np.full(frames, 1 / frames), replicates)
    return drawn.astype(np.float64, order="F")


def ranked_replicates(
    weights: Float[np.ndarray, " n"],
    correct: Bool[np.ndarray, " n"],
    frame_index: Int[np.ndarray, " n"],
    draws: Float[np.ndarray, "r f"],
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, " r"]]:
    """Return the AUROC and the average precision of the weights in each draw, NaN where undefined.

    Args:
        weights: (n,) weights of the labels.
        correct: (n,) bool.
        frame_index: (n,) integer in [0, f), the frame of each label.
        draws: (r, f) counts, see `draw_frames`.

    Returns:
        (r,) AUROC and (r,) average precision.
    """
    order = np.argsort(-weights, kind="stable")
    ends = np.append(np.diff(weights[order]) != 0, True)[: len(order)]
    by_frame = np.ascontiguousarray(draws.T)
    found, area = np.empty(len(draws)), np.empty(len(draws))
    for start in range(0, len(draws), _BLOCK):
        block = slice(start, start + _BLOCK)
        columns = frame_index[order], correct[order], ends
        found[block], area[block] = _rank(by_frame[:, block], *columns)
    return found, area


@njit(cache=True, nogil=True, error_model="numpy")
def _rank(
    draws: np.ndarray, frame_index: np.ndarray, correct: np.ndarray, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the AUROC and average precision of labels by falling weight, for (f, b) draws.

    `ends` marks the last label of each group of equal weights; a group is one step. The innermost
    loop runs over the draws, because the compiler can vectorise it.

    Example, one draw that contains each frame once: weights 0.9, 0.5, 0.5, 0.2 of labels that are
    correct, correct, wrong, wrong; `ends` is True, False, True, True.

    step  weight  correct, wrong here  added to wins                  added to area
    1     0.9     1, 0                 -                              1 * 1 / 1
    2     0.5     1, 1                 1 * (1 + 1/2), the tie is half 1 * 2 / 3
    3     0.2     0, 1                 1 * 2                          -

    AUROC = wins / (2 correct * 2 wrong) = 3.5 / 4; average precision = area / 2 = (1 + 2/3) / 2.
    """
    count = draws.shape[1]
    step_correct, step_wrong, wins, area = np.zeros((4, count))
    heavier_correct, heavier = np.zeros((2, count))
    has_correct = has_wrong = False
    for i in range(len(frame_index)):
        times = draws[frame_index[i]]
        if correct[i]:
            has_correct = True
            for b in range(count):
                step_correct[b] += times[b]
        else:
            has_wrong = True
            for b in range(count):
                step_wrong[b] += times[b]
        if ends[i] and has_wrong:
            for b in range(count):
                wins[b] += step_wrong[b] * (heavier_correct[b] + step_correct[b] / 2)
                heavier[b] += step_wrong[b]
                step_wrong[b] = 0.0
        if ends[i] and has_correct:
            for b in range(count):
                heavier_correct[b] += step_correct[b]
                heavier[b] += step_correct[b]
                # While no label is drawn yet, this adds 0 / 1 instead of 0 / 0.
                area[b] += step_correct[b] * heavier_correct[b] / max(heavier[b], 1.0)
                step_correct[b] = 0.0
        if ends[i]:
            has_correct = has_wrong = False
    # Without a pair, or without a correct label, 0 / 0 gives the NaN that is documented.
    return wins / (heavier_correct * (heavier - heavier_correct)), area / heavier_correct
