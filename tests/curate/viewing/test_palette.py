"""The colour scales."""

import numpy as np
import pytest

from curate.errors import ConfigError
from curate.viewing.palette import DARK, PAPER, find_style, height_shades, weight_colours


def lightness(colours):
    """Return CIE L* of (n, 3) sRGB colours, 0 to 100."""
    linear = np.where(
        colours <= 10, colours / 255 / 12.92, ((colours / 255 + 0.055) / 1.055) ** 2.4
    )
    luminance = linear @ np.array([0.2126, 0.7152, 0.0722])
    return 116 * np.cbrt(np.maximum(luminance, 0.008856)) - 16


def test_a_higher_weight_is_a_lighter_colour():
    """Lightness rises along the whole scale, with a large range."""
    steps = lightness(weight_colours(np.linspace(0.001, 1, 200)).astype(float))
    assert (np.diff(steps) > -0.4).all()
    assert steps[-1] - steps[0] > 40


def test_every_weight_is_distinct_from_the_background():
    """The lowest weight is still far lighter than the background."""
    lowest = lightness(weight_colours(np.array([0.001])).astype(float))
    assert lowest - lightness(np.array([DARK.background], dtype=float)) > 25


def test_weight_0_is_not_on_the_scale():
    """Ignored labels are grey; tiny weights are not."""
    colours = weight_colours(np.array([0.0, 1e-9, 1.0]))
    assert tuple(colours[0]) == DARK.zero_weight
    assert tuple(colours[1]) != DARK.zero_weight
    assert np.ptp(colours[1].astype(int)) > 60
    assert weight_colours(np.zeros(0)).shape == (0, 3)


def test_higher_points_are_lighter():
    """They remain within 8 bits outside the usual heights."""
    shades = height_shades(np.array([-50.0, -1.7, 0.0, 1.5, 50.0]))
    assert (np.diff(shades.astype(int), axis=0) >= 0).all()
    assert shades[0].tolist() < shades[2].tolist() < shades[4].tolist()


def test_on_paper_a_higher_weight_is_darker_and_all_are_darker_than_the_background():
    """A grey print keeps their order."""
    steps = lightness(weight_colours(np.linspace(0.001, 1, 200), PAPER).astype(float))
    assert (np.diff(steps) < 0.4).all()
    assert steps[0] - steps[-1] > 40
    assert lightness(np.array([PAPER.background], dtype=float)) - steps[0] > 20


@pytest.mark.parametrize("style", [DARK, PAPER])
def test_text_and_lines_have_enough_contrast(style):
    """WCAG's contrast of 4.5 for text, 3 for lines."""

    def contrast(colour):
        one, other = (
            np.where(c <= 10, c / 255 / 12.92, ((c / 255 + 0.055) / 1.055) ** 2.4)
            @ np.array([0.2126, 0.7152, 0.0722])
            for c in (np.array(colour, float), np.array(style.background, float))
        )
        return (max(one, other) + 0.05) / (min(one, other) + 0.05)

    assert min(contrast(style.text), contrast(style.faint_text)) >= 4.5
    lines = (style.ground_truth, style.human, style.zero_weight, style.unweighted)
    assert min(map(contrast, lines)) >= 3


def test_an_unknown_style_is_an_error():
    """Its message lists the known ones."""
    assert find_style("paper") is PAPER
    with pytest.raises(ConfigError, match="--style light: use dark or paper"):
        find_style("light")
