"""Draw the weighted labels of a frame into image files."""

from pathlib import Path

import numpy as np

from curate.errors import ConfigError
from curate.files.atomic import replace_file
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.geometry.projection import camera_of_boxes
from curate.viewing.bird_eye import draw_bird_eye
from curate.viewing.canvas import Canvas, save_png
from curate.viewing.chart_style import ImageFormat
from curate.viewing.frame_view import paint_frame
from curate.viewing.overlay import FrameContent, draw_overlay
from curate.viewing.palette import DARK, Style
from curate.viewing.tags import ShownLabels
from pipelines.labels.by_frame import chosen_round
from pipelines.labels.columns import LabelColumns, read_columns
from pipelines.labels.of_one_frame import FrameBoxes, read_frame
from pipelines.stages.methods import zero_weight_of
from pipelines.workspace.workspace import Workspace


def draw_example_frame(workspace: Workspace, round_number: int) -> list[Path]:
    """Draw the bird's eye view and the image overlay of the example frame; return their paths."""
    return draw_labels(workspace, round_number, find_example_frame(workspace, round_number))


def find_example_frame(workspace: Workspace, round_number: int) -> str:
    """Return the name of the frame with the most labels of both high and low weight."""
    policy = workspace.config.run.method
    found = read_columns(workspace, round_number, policy)
    return str(found.frame_names[_most_varied(found)])


def draw_view(
    workspace: Workspace,
    name: str,
    round_number: int | None = None,
    policy: str | None = None,
    output: Path | None = None,
    *,
    kind: ImageFormat = "png",
    style: Style = DARK,
) -> Path:
    """Draw camera image and bird's eye view of any frame into one file; return its path.

    Args:
        workspace: see `Workspace`.
        name: name of the frame.
        round_number: the round; None for the last round with predictions.
        policy: the policy that gave the weights; None for the configured one.
        output: path of the file; None for a file in the folder `pictures`.
        kind: format of the file.
        style: colours.

    Raises:
        ConfigError: if no frame has this name, or `output` cannot be written.
        WorkspaceError: if the round has no predictions.
    """
    number = chosen_round(workspace, round_number)
    policy = policy or workspace.config.run.method
    content = _painted(workspace, name, (number, policy), kind, style).content(kind)
    path = output or workspace.root / "pictures" / f"round-{number:02d}-{name}-{policy}.{kind}"
    if path.is_dir() or not path.parent.is_dir():
        raise ConfigError(f"--output {path}: must be a file in an existing folder")
    replace_file(path, content)
    return path


def frame_picture(workspace: Workspace, name: str, round_number: int, policy: str) -> np.ndarray:
    """Return camera image and bird's eye view of any frame as (height, width, 3) uint8 RGB.

    Raises:
        ConfigError: if no frame has this name.
    """
    return _painted(workspace, name, (round_number, policy), "png", DARK).finish()


def shown_labels(workspace: Workspace, frame: Frame, found: FrameBoxes, policy: str) -> ShownLabels:
    """Return the labels of a frame for drawing, with their points counted."""
    labels = found.labels
    return ShownLabels(
        labels.boxes,
        labels.categories,
        labels.scores,
        found.weights,
        count_points_in_boxes(frame.points, labels.boxes),
        zero_weight_of(workspace.config, policy),
        found.numbers,
        found.decisions,
        unseen=camera_of_boxes(labels.boxes, frame.cameras) < 0 if frame.cameras else None,
    )


def draw_labels(workspace: Workspace, round_number: int, name: str) -> list[Path]:
    """Draw image overlay and bird's eye view into two files in `pictures`; return their paths."""
    policy = workspace.config.run.method
    frame = workspace.dataset.read(name, image=True)
    found = read_frame(workspace, name, round_number, policy)
    labels = shown_labels(workspace, frame, found, policy)
    title = f"frame {name}, round {round_number}, weights by {policy}"
    stem = f"round-{round_number:02d}-{name}-{policy}"
    pictures = {
        f"{stem}-bird-eye.png": draw_bird_eye(frame.points, labels, title=title),
    }
    if frame.image is not None:
        overlay = draw_overlay(frame.image, frame.calibration, labels, title=title)
        pictures[f"{stem}-image.png"] = overlay
    folder = workspace.root / "pictures"
    for file, picture in pictures.items():
        save_png(folder / file, picture)
    return [folder / file for file in pictures]


def picture_title(name: str, found: FrameBoxes, round_number: int, policy: str) -> str:
    """Return the title of a frame's picture; a frame without predictions does not look empty."""
    content = f"weights by {policy}" if len(found.labels) else "no predictions stored"
    return f"frame {name} ({found.split}), round {round_number}, {content}"


def _painted(
    workspace: Workspace, name: str, weighted: tuple[int, str], kind: ImageFormat, style: Style
) -> Canvas:
    """Draw a frame with the labels of a round and a policy."""
    number, policy = weighted
    found = read_frame(workspace, name, number, policy)
    frame = workspace.dataset.read(name, image=True)
    shown = FrameContent(
        shown_labels(workspace, frame, found, policy),
        found.truth_boxes,
        found.repredictions,
        picture_title(name, found, number, policy),
        style,
    )
    return paint_frame(frame, shown, kind)


def _most_varied(found: LabelColumns) -> int:
    """Return the frame with the most near labels of both high and low weight."""
    near, count = found.boxes[:, 0] < 40, len(found.frame_names)
    high = np.bincount(found.frames[near & (found.weights > 0.3)], minlength=count)
    low = np.bincount(found.frames[near & (found.weights < 0.1)], minlength=count)
    return int(np.argmax(np.minimum(high, low) + 0.01 * high))
