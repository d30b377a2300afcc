"""The colours of images: weight scale, ground truth, text and background.

The weight scale interpolates between a few anchors, similar to viridis. Its lightness changes
evenly, so that weights can be distinguished in print and by colour-blind readers: a higher weight
is lighter on the dark background, and darker on the white background of the paper style.
"""

from dataclasses import dataclass

import numpy as np

from curate.errors import ConfigError

Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Style:
    """The RGB colours of an image.

    Attributes:
        background: background of the bird's eye view, and the rim around boxes on an image.
        panel: background of titles and legends.
        grid: distance rings.
        text: titles and names.
        faint_text: secondary text.
        ground_truth: ground truth boxes.
        human: boxes that people decided on.
        zero_weight: labels of weight 0.
        unweighted: labels without a weight.
        weights: anchors of the weight scale from 0 to 1.
        points: LiDAR points 2 m below the LiDAR (ground) and 2 m above it.
    """

    background: Colour
    panel: Colour
    grid: Colour
    text: Colour
    faint_text: Colour
    ground_truth: Colour
    human: Colour
    zero_weight: Colour
    unweighted: Colour
    weights: tuple[Colour, ...]
    points: tuple[Colour, Colour]


DARK = Style(
    background=(13, 16, 21),
    panel=(22, 26, 33),
    grid=(44, 51, 62),
    text=(226, 231, 238),
    faint_text=(139, 150, 165),
    ground_truth=(255, 255, 255),
    human=(255, 96, 208),
    zero_weight=(128, 134, 146),
    unweighted=(236, 128, 84),
    weights=(
        (116, 82, 190), (76, 124, 205), (32, 168, 186), (66, 201, 140), (158, 222, 88),
        (253, 231, 37),
    ),
    points=((74, 88, 108), (186, 199, 215)),
)  # fmt: skip
PAPER = Style(
    background=(255, 255, 255),
    panel=(255, 255, 255),
    grid=(226, 229, 234),
    text=(20, 24, 30),
    faint_text=(88, 98, 112),
    ground_truth=(0, 0, 0),
    human=(200, 0, 140),
    zero_weight=(112, 118, 128),
    unweighted=(200, 80, 30),
    weights=(
        (150, 205, 60), (60, 180, 110), (30, 150, 140), (40, 112, 142), (60, 75, 140), (68, 10, 88),
    ),
    points=((196, 203, 212), (120, 130, 144)),
)  # fmt: skip
STYLES = {"dark": DARK, "paper": PAPER}


def find_style(name: str) -> Style:
    """Return the style with this name.

    Raises:
        ConfigError: if the style is unknown.
    """
    if name not in STYLES:
        raise ConfigError(f"--style {name}: use {' or '.join(STYLES)}")
    return STYLES[name]


def weight_colours(weights: np.ndarray, style: Style = DARK) -> np.ndarray:
    """Return the (n, 3) uint8 RGB colours of (n,) weights in [0, 1].

    Weight 0 (not learned as an object) is grey; NaN (a label without weight) is orange.
    """
    unknown = np.isnan(weights)
    place = np.clip(np.where(unknown, 0, weights), 0, 1) * (len(style.weights) - 1)
    anchors = np.array(style.weights)
    channels = [np.interp(place, np.arange(len(anchors)), channel) for channel in anchors.T]
    colours: np.ndarray = np.rint(np.stack(channels, axis=-1)).astype(np.uint8)
    colours[np.asarray(weights) <= 0] = style.zero_weight
    colours[unknown] = style.unweighted
    return colours


def height_shades(heights: np.ndarray, style: Style = DARK) -> np.ndarray:
    """Return (n, 3) uint8 RGB colours of LiDAR points by their z in metres; the ground is faint."""
    share = np.clip((np.asarray(heights) + 2.0) / 4.0, 0, 1)[:, None]
    low, high = np.array(style.points)
    shades: np.ndarray = np.rint(low + share * (high - low)).astype(np.uint8)
    return shades
