"""The columns of a round do not depend on the row order of the database."""

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from db.models import BOX_COLUMNS
from pipelines.labels.columns import ordered

NUMBERS = ("score", "loss", "weight")
# No deadline: on a busy machine the run time of an example says nothing.
_PATIENT = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


@_PATIENT
@given(st.permutations(range(12)))
def test_any_order_of_rows_gives_the_same_columns(order: list[int]) -> None:
    """Sorted by frame name, then by k; each row stays together."""
    names, kinds = ["b", "c", "a"], ["Car", "Cyclist"]
    numbers = dict.fromkeys((*BOX_COLUMNS, *NUMBERS), np.array(order, dtype=float))
    columns = {
        "frame": [names[i % 3] for i in order],
        "k": np.array(order) // 3,
        "category": [kinds[i % 2] for i in order],
    }
    found = ordered(columns | numbers, ("Car", "Cyclist"))
    assert found.frame_names == ["a", "b", "c"]
    shown = [found.frame_names[i] for i in found.frames]
    assert list(zip(shown, found.k.tolist(), strict=True)) == [
        (name, k) for name in "abc" for k in range(4)
    ]
    was = found.weights.astype(int)
    assert [names[i % 3] for i in was] == shown
    assert (found.categories == was % 2).all()
    assert (found.boxes[:, 0] == was).all()
