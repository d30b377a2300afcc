"""The splits of a workspace's frames."""

from collections.abc import Collection, Mapping

SPLITS = ("labeled", "unlabeled", "val", "calibration")
WITH_TRUTH = ("labeled", "val", "calibration")
"""The splits with ground truth in the database."""
HELD_OUT = ("val", "calibration")
"""Those of them that nothing is trained on."""


def count_frames(splits: Mapping[str, Collection[str]]) -> dict[str, int]:
    """Return the number of frames of each split, without that for calibration if it has none."""
    counts = {split: len(frames) for split, frames in splits.items()}
    return {split: count for split, count in counts.items() if count or split != "calibration"}
