"""The images of the README and the docs, and the script that draws them."""

import numpy as np
from PIL import Image
from support.paths import ROOT
from support.toys import toy_calibration

from curate.frames import Frame
from curate.viewing.palette import weight_colours
from curate.viewing.tags import ShownLabels
from docs.make_pictures import _RAW, before_after, results_chart, save_small_png


def has(drawn, colour):
    """Return whether a colour is in an image."""
    return (np.abs(drawn.astype(int) - np.array(colour)).max(axis=-1) < 4).any()


def test_the_left_half_has_one_colour_and_the_right_half_those_of_the_weights():
    """On the image and from above; weight 0 is grey."""
    image = np.full((375, 1242, 3), 90, np.uint8)
    points = np.zeros((0, 4), np.float32)
    frame = Frame("000000", points, toy_calibration(), (1242, 375), image)
    boxes = np.array([[20.0, 3, 0, 4, 2, 1.5, 0.3], [30, -5, 0, 4, 2, 1.5, 0]])
    weights = np.array([0.7, 0.0])
    labels = ShownLabels(boxes, np.array(["Car"] * 2), np.array([0.9, 0.8]), weights)
    drawn = before_after(frame, labels)
    # Without the legend, which shows all colours.
    left, right = drawn[:-40, :620], drawn[:-40, 632:]
    trusted, zero = weight_colours(weights)
    assert has(left, _RAW)
    assert not has(left, trusted)
    assert has(right, trusted)
    assert has(right, zero)
    assert not has(right, _RAW)


def test_a_small_image_keeps_the_colours_of_the_weights(tmp_path):
    """Though most of it has other colours."""
    noise = np.random.default_rng(0).integers(100, 160, (200, 200, 3), dtype=np.uint8)
    colours = weight_colours(np.linspace(0.05, 1, 20))
    noise[0, :20] = colours
    save_small_png(tmp_path / "a.png", noise)
    read = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
    assert np.abs(read[0, :20].astype(int) - colours).max() <= 6


def test_the_chart_of_the_results_shows_their_tables():
    """Both overlaps; missing values are left out."""
    figure = results_chart((ROOT / "docs" / "results.md").read_text(encoding="utf-8")).figure
    strict, relaxed = figure.axes
    assert strict.get_title(loc="left") == "Mean 3D AP, IoU 0.7/0.5/0.5"
    named = {
        text.get_text().split()[0]: line.get_ydata().tolist()
        for text, line in zip(
            strict.get_legend().get_texts(),
            sorted(strict.lines, key=lambda line: -line.get_ydata()[-1]),
            strict=True,
        )
    }
    assert named["pspsl"] == [21.1, 27.9, 28.6]
    assert named["baseline"] == [18.9, 24.3, 25.4, 27.1]
    assert len(relaxed.lines) == len(named)


def test_the_images_of_the_docs_are_small():
    """At most 400 kB each."""
    for name in ("before-after.png", "overlay.png", "results.png"):
        assert (ROOT / "docs" / name).stat().st_size < 400_000
