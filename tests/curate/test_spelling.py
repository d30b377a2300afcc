"""Suggestions for misspelled names."""

import pytest

from curate.spelling import did_you_mean

KNOWN = ("kitti", "kitti-raw", "nuscenes", "MyDetector")


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("kiti", "kitti"),
        ("KITTI_raw", "kitti-raw"),
        ("nuscene", "nuscenes"),
        ("mydetektor", "MyDetector"),
    ],
)
def test_the_closest_name_is_suggested(word: str, meant: str) -> None:
    """Neither case nor the separator counts as a difference."""
    assert did_you_mean(word, KNOWN) == f"; did you mean '{meant}'?"


@pytest.mark.parametrize("word", ["", "waymo-open", "x"])
def test_a_name_without_a_similar_one_gets_no_suggestion(word: str) -> None:
    """A wrong suggestion would mislead."""
    assert did_you_mean(word, KNOWN) == ""
