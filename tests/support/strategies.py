"""Hypothesis strategies for boxes and similarities."""

import numpy as np
from hypothesis import strategies as st

from curate.geometry.similarity import Similarity

angles = st.one_of(
    st.floats(-np.pi, np.pi, exclude_min=True),
    st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi, np.pi / 4, 1e-9, -1e-13]),
)
sides = st.one_of(st.floats(0.05, 8.0), st.sampled_from([0.0, 1.0, 2.0]))
offsets = st.one_of(st.floats(-4.0, 4.0), st.sampled_from([0.0, 0.5, 1.0, -1.0, 2.0]))


@st.composite
def box_arrays(draw, min_size=0, max_size=6):
    """Draw (n, 7) boxes near the origin, often touching, nested, parallel, equal or flat."""
    box = st.tuples(offsets, offsets, offsets, sides, sides, sides, angles)
    rows = draw(st.lists(box, min_size=min_size, max_size=max_size))
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


similarities = st.builds(
    Similarity,
    flip_y=st.booleans(),
    rotation_rad=st.floats(-7.0, 7.0),
    scale=st.floats(0.1, 10.0),
)
