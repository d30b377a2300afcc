"""The columns of a round do not depend on the order in which a database gives its rows."""

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipelines.labels.columns import joined, ordered

NUMBERS = ("score", "loss", "weight")
# How long an example takes says nothing on a busy machine.
_PATIENT = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


@_PATIENT
@given(st.permutations(range(12)))
def test_any_order_of_rows_gives_the_same_columns(order: list[int]) -> None:
    """By name of the frame, then by k; each row stays whole."""
    names = ["b", "c", "a"]
    key = np.array([(i % 3, i // 3, i % 2) for i in range(12)])[order]
    table = np.repeat(np.array(order, dtype=float)[:, None], 7 + len(NUMBERS), axis=1)
    found = ordered(names, ("Car", "Cyclist"), key, table, NUMBERS)
    assert found.frame_names == ["a", "b", "c"]
    shown = [found.frame_names[i] for i in found.frames]
    assert list(zip(shown, found.k.tolist(), strict=True)) == [
        (name, k) for name in "abc" for k in range(4)
    ]
    was = found.weights.astype(int)
    assert [names[i % 3] for i in was] == shown
    assert (found.categories == was % 2).all()
    assert (found.boxes[:, 0] == was).all()


@_PATIENT
@given(st.lists(st.integers(0, 5), min_size=1, max_size=6))
def test_chunks_are_joined_in_their_order(sizes: list[int]) -> None:
    """Empty ones too, and the list is used up."""
    rows = np.arange(2 * sum(sizes)).reshape(-1, 2)
    chunks = [rows[sum(sizes[:i]) : sum(sizes[: i + 1])] for i in range(len(sizes))]
    assert (joined(chunks) == rows).all()
    assert chunks == []
