"""Sequences: frames of one drive look almost the same, so a drive belongs to one split."""

from collections.abc import Iterable, Mapping
from itertools import combinations

import numpy as np

from curate.errors import ConfigError


def shared_sequences(
    sequences: Mapping[str, str], splits: Mapping[str, Iterable[str]]
) -> Mapping[tuple[str, str], list[str]]:
    """Return the sequences that two splits share, by pair of splits.

    Args:
        sequences: the sequence of each frame; frames without a sequence are absent.
        splits: the frames of each split.
    """
    sequences_of = {
        name: {sequences[frame] for frame in frames if frame in sequences}
        for name, frames in splits.items()
    }
    shared = {
        (one, other): sorted(sequences_of[one] & sequences_of[other])
        for one, other in combinations(sequences_of, 2)
    }
    return {pair: names for pair, names in shared.items() if names}


def choose_sequences(
    sequences: Mapping[str, str],
    pool: Iterable[str],
    count: int,
    generator: np.random.Generator,
) -> list[str]:
    """Choose whole sequences at random until their number of frames is closest to a count.

    Args:
        sequences: the sequence of each frame; a frame without one is its own sequence.
        pool: the frames to choose from.
        count: number of frames to choose, at least one.
        generator: draws the order.

    Raises:
        ConfigError: if all frames belong to one sequence, so that a part of them cannot be chosen.
    """
    groups = group_by_sequence(sequences, pool)
    if len(groups) == 1 and 0 < count < len(next(iter(groups.values()))):
        raise ConfigError(
            f"all {len(next(iter(groups.values())))} frames belong to sequence "
            f"{next(iter(groups))}; splitting it would put near-duplicate frames on both sides. "
            "Add more sequences, or split by frame anyway with --split-by frame"
        )
    chosen: list[str] = []
    for name in generator.permutation(sorted(groups)).tolist():
        if abs(len(chosen) + len(groups[name]) - count) < abs(len(chosen) - count):
            chosen += groups[name]
    return chosen or min(groups.values(), key=lambda group: (len(group), group))


def group_by_sequence(
    sequences: Mapping[str, str], frames: Iterable[str]
) -> Mapping[str, list[str]]:
    """Return the frames of each sequence; a frame without one is its own sequence."""
    groups: dict[str, list[str]] = {}
    for frame in frames:
        groups.setdefault(sequences.get(frame, frame), []).append(frame)
    return groups
