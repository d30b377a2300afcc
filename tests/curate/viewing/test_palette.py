"""Tests of the colour scales."""

import numpy as np

from curate.viewing.palette import BACKGROUND, ZERO_WEIGHT, height_shades, weight_colours


def lightness(colours):
    """CIE L* of (n, 3) sRGB colours, 0 to 100."""
    linear = np.where(
        colours <= 10, colours / 255 / 12.92, ((colours / 255 + 0.055) / 1.055) ** 2.4
    )
    luminance = linear @ np.array([0.2126, 0.7152, 0.0722])
    return 116 * np.cbrt(np.maximum(luminance, 0.008856)) - 16


def test_a_higher_weight_is_a_lighter_colour():
    """Lightness rises all along the scale, and by a lot from end to end."""
    steps = lightness(weight_colours(np.linspace(0.001, 1, 200)).astype(float))
    assert (np.diff(steps) > -0.4).all()
    assert steps[-1] - steps[0] > 40


def test_every_weight_stands_out_from_the_ground():
    """The lowest weight is still far lighter than the background."""
    lowest = lightness(weight_colours(np.array([0.001])).astype(float))
    assert lowest - lightness(np.array([BACKGROUND], dtype=float)) > 25


def test_weight_0_is_not_on_the_scale():
    """Ignored labels are grey; tiny weights are not."""
    colours = weight_colours(np.array([0.0, 1e-9, 1.0]))
    assert tuple(colours[0]) == ZERO_WEIGHT
    assert tuple(colours[1]) != ZERO_WEIGHT
    assert np.ptp(colours[1].astype(int)) > 60
    assert weight_colours(np.zeros(0)).shape == (0, 3)


def test_points_are_lighter_the_higher_they_are():
    """And remain within 8 bits outside the usual heights."""
    shades = height_shades(np.array([-50.0, -1.7, 0.0, 1.5, 50.0]))
    assert (np.diff(shades.astype(int), axis=0) >= 0).all()
    assert shades[0].tolist() < shades[2].tolist() < shades[4].tolist()
