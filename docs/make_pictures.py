"""Draws the pictures of the README and of the docs anew.

    python -m docs.make_pictures DEMO

DEMO is the folder that `curate demo DEMO --frames 60 --val 20 --labeled 0.2` has made. The script
writes docs/overlay.png, labels over an image, and docs/before-after.png, the predictions as they
are beside the weighted labels. Both show the frame with most of trusted and of mistrusted labels.
docs/results.png is drawn from the tables of docs/results.md, also without DEMO.
"""

import re
import sys
from pathlib import Path

import cv2
import numpy as np

from curate.frames import Frame
from curate.geometry.boxes import bev_corners
from curate.viewing.bird_eye import Region
from curate.viewing.canvas import Canvas
from curate.viewing.chart_style import Chart
from curate.viewing.charts import Curve, CurvePanel, curves_chart
from curate.viewing.legend import STRIP_HEIGHT, TITLE_HEIGHT, draw_legend
from curate.viewing.overlay import box_strokes, draw_overlay
from curate.viewing.palette import DARK, Colour, height_shades, weight_colours
from curate.viewing.tags import ShownLabels
from pipelines.labels.of_one_frame import read_frame
from pipelines.reports.pictures import find_example_frame, shown_labels
from pipelines.workspace.workspace import Workspace

DOCS = Path(__file__).resolve().parent
_COLUMN, _GAP = 620, 12
_REGION = Region(-1.0, 47.0, -25.0, 25.0, _COLUMN / 50.0)
_RAW: Colour = (255, 138, 76)


def before_after(frame: Frame, labels: ShownLabels) -> np.ndarray:
    """Return the picture: predictions in one colour, and the same labels by weight."""
    if frame.image is None:
        raise ValueError(frame.frame_id)
    image = cv2.medianBlur(frame.image, 3)  # the noise of the simulated camera is most of the file
    rows = round(_COLUMN * image.shape[0] / image.shape[1])
    below = TITLE_HEIGHT + rows + _GAP
    height = below + _REGION.size[1] + STRIP_HEIGHT
    canvas = Canvas(2 * _COLUMN + _GAP, height, DARK.background)
    n, kept = len(labels), int((labels.weights > 0.1).sum())
    titles = (
        f"{n} predictions of the teacher, as they are",
        f"the same as weighted labels: {kept} with v > 0.1",
    )
    for column, (title, weighted) in enumerate(zip(titles, (False, True), strict=True)):
        left = column * (_COLUMN + _GAP)
        colours = weight_colours(labels.weights) if weighted else np.tile(_RAW, (n, 1))
        strength = labels.weights if weighted else np.full(n, 0.5)
        panel = Canvas(_COLUMN, height - STRIP_HEIGHT, DARK.background)
        panel.text(8, 24, title, DARK.text, 16)
        street = panel.part(TITLE_HEIGHT, rows)
        _draw_image(street, frame, image, labels.boxes, colours, strength)
        _draw_above(panel.part(below, _REGION.size[1]), frame, labels.boxes, colours, strength)
        canvas.image(left, 0, _COLUMN, height - STRIP_HEIGHT, panel.finish())
    draw_legend(canvas, truth=False, zero_weight=labels.zero_weight)
    return canvas.finish()


def _draw_image(
    canvas: Canvas,
    frame: Frame,
    image: np.ndarray,
    boxes: np.ndarray,
    colours: np.ndarray,
    strength: np.ndarray,
) -> None:
    """Draw boxes over the image, weak ones first."""
    canvas.image(0, 0, canvas.width, canvas.height, image)
    factor = canvas.width / image.shape[1]
    strokes_of = box_strokes(boxes, frame.calibration, frame.image_size)
    for i in np.argsort(strength, kind="stable"):
        strokes, colour = strokes_of[i] * factor, tuple(colours[i].tolist())
        if len(strokes) == 12:
            canvas.fill(strokes[:4, 0], colour, 0.45 * strength[i])
        if len(strokes):
            canvas.lines(strokes, colour, 1.0 + 1.2 * strength[i])


def _draw_above(
    canvas: Canvas, frame: Frame, boxes: np.ndarray, colours: np.ndarray, strength: np.ndarray
) -> None:
    """Draw points and footprints from above, weak ones first."""
    points = frame.points[np.argsort(frame.points[:, 2], kind="stable")]
    title = np.array([0, TITLE_HEIGHT])  # for which a region leaves room
    places = _REGION.to_pixels(points[:, :2].astype(np.float64)) - title
    canvas.dots(places, height_shades(points[:, 2]))
    footprints = _REGION.to_pixels(bev_corners(boxes)) - title
    for i in np.argsort(strength, kind="stable"):
        outline, colour = footprints[i], tuple(colours[i].tolist())
        canvas.fill(outline, colour, 0.7 * strength[i])
        canvas.lines(outline, colour, 1.0 + 1.4 * strength[i], closed=True)
        front = (outline[0] + outline[3]) / 2
        canvas.lines(np.stack([outline.mean(axis=0), front]), colour, 1.0 + 1.4 * strength[i])


def save_small_png(path: Path, rgb: np.ndarray) -> None:
    """Write a PNG with 256 colours, among them those that carry meaning: a third of the size."""
    from PIL import Image

    picture = Image.fromarray(rgb)
    scale = [_RAW, DARK.text, DARK.zero_weight, *weight_colours(np.linspace(1e-6, 1, 61)).tolist()]
    others = picture.quantize(256 - len(scale)).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([*np.ravel(scale).tolist(), *others[: 3 * (256 - len(scale))]])
    picture.quantize(palette=palette, dither=Image.Dither.NONE).save(path, optimize=True)


def results_chart(text: str) -> Chart:
    """Return the chart of docs/results.md: mean 3D AP over the labeled ratio, by method.

    Args:
        text: of the page, with tables whose cells hold "mean ± standard deviation" or "-".
    """
    panels = []
    for title, table in re.findall(r"### (Mean 3D AP, [^\n]*), by labeled ratio\n\n(.*?)\n\n", text,
                                   re.DOTALL):  # fmt: skip
        head, _, *lines = ([cell.strip() for cell in line.split("|")[1:-1]]
                           for line in table.splitlines())  # fmt: skip
        shares = np.array([float(name.removesuffix("%")) / 100 for name in head[1:]])
        curves = []
        for name, *cells in lines:
            found = [re.match(r"([\d.]+) ± ([\d.]+)", cell) for cell in cells]
            values = [[float(f[1]), float(f[2])] if f else [np.nan] * 2 for f in found]
            curves.append(Curve(name, *np.array(values).T))
        panels.append(CurvePanel(title, shares, curves))
    note = (
        "dot: mean over 3 seeds; bar: standard deviation; legend: AP at a line's end; AP R40, "
        "mean over categories and difficulties; teacher: on X_l once, baseline: on X_l as long as "
        "the other methods"
    )
    return curves_chart(panels, "AP over labeled ratio", note)


def main(folder: Path) -> None:
    """Draw labels over an image, and the predictions beside the weighted labels.

    Args:
        folder: of the demo.
    """
    workspace = Workspace.open(folder)
    policy = workspace.config.run.method
    name = find_example_frame(workspace, 1)
    frame = workspace.dataset.read(name, image=True)
    labels = shown_labels(workspace, frame, read_frame(workspace, name, 1, policy), policy)
    if frame.image is None:
        raise ValueError(name)
    title = f"frame {name}, round 1, weights by {policy}"
    overlay = draw_overlay(frame.image, frame.calibration, labels, title=title)
    save_small_png(DOCS / "overlay.png", overlay)
    save_small_png(DOCS / "before-after.png", before_after(frame, labels))


if __name__ == "__main__":
    results_chart((DOCS / "results.md").read_text(encoding="utf-8")).save(DOCS / "results.png")
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
