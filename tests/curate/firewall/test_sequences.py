"""Whole sequences go into one split."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curate.errors import ConfigError
from curate.firewall.sequences import choose_sequences, shared_sequences


@given(st.dictionaries(st.integers(0, 200).map(str), st.integers(0, 9).map(str), min_size=1),
       st.floats(0.01, 1), st.integers(0, 5))  # fmt: skip
def test_a_choice_has_whole_sequences(sequences: dict, share: float, seed: int) -> None:
    """With about as many frames as requested: no sequence added or removed would be closer."""
    count = max(1, round(share * len(sequences)))
    generator = np.random.default_rng(seed)
    sizes = [list(sequences.values()).count(name) for name in set(sequences.values())]
    if len(sizes) == 1 and count < sizes[0]:
        with pytest.raises(ConfigError, match="--split-by frame"):
            choose_sequences(sequences, sequences, count, generator)
        return
    chosen = choose_sequences(sequences, sequences, count, generator)
    rest = set(sequences) - set(chosen)
    assert len(chosen) == len(set(chosen)) > 0
    assert shared_sequences(sequences, {"labeled": chosen, "unlabeled": rest}) == {}
    assert abs(len(chosen) - count) <= max(sizes)


def test_frames_without_a_sequence_are_their_own_sequence() -> None:
    """As in a dataset of single frames."""
    chosen = choose_sequences({}, map(str, range(10)), 4, np.random.default_rng(0))
    assert len(chosen) == 4


def test_shared_sequences_are_reported_by_pair_of_splits() -> None:
    sequences = {"a1": "a", "a2": "a", "b1": "b", "c1": "c", "a3": "a"}
    splits = {"labeled": ["a1"], "unlabeled": ["b1", "a2"], "val": ["c1", "a3"]}
    assert shared_sequences(sequences, splits) == {
        ("labeled", "unlabeled"): ["a"], ("labeled", "val"): ["a"], ("unlabeled", "val"): ["a"],
    }  # fmt: skip
