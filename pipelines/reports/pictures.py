"""Pictures of a frame's weighted labels."""

from pathlib import Path

import numpy as np

from curate.errors import ConfigError, DataError
from curate.files.atomic import replace_file
from curate.frames import Frame
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.viewing.bird_eye import draw_bird_eye
from curate.viewing.canvas import Canvas, save_png
from curate.viewing.chart_style import ImageFormat
from curate.viewing.frame_view import paint_frame
from curate.viewing.overlay import Shown, draw_overlay
from curate.viewing.palette import DARK, Style
from curate.viewing.tags import ShownLabels
from pipelines.labels.columns import LabelColumns, read_columns
from pipelines.labels.of_one_frame import FrameBoxes, chosen_round, read_frame
from pipelines.stages.methods import zero_weight_of
from pipelines.workspace.workspace import Workspace


def draw_example_frame(workspace: Workspace, round_number: int) -> list[Path]:
    """Draw a bird's eye view and an image overlay of the frame that `find_example_frame` finds."""
    return draw_labels(workspace, round_number, find_example_frame(workspace, round_number))


def find_example_frame(workspace: Workspace, round_number: int) -> str:
    """Return the name of the frame with most of both trusted and mistrusted labels."""
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
    """Draw image and bird's eye view of any frame into one file; return its path.

    Args:
        workspace: see `Workspace`.
        name: of the frame.
        round_number: None for the last that has predictions.
        policy: whose weights; None for the configured one.
        output: None for a file in the folder `pictures`.
        kind: format of the file.
        style: colours.

    Raises:
        ConfigError: if no frame has that name, or a picture cannot be written to `output`.
        WorkspaceError: if the round has no predictions.
    """
    number = chosen_round(workspace, round_number)
    policy = policy or workspace.config.run.method
    content = _painted(workspace, name, (number, policy), kind, style).content(kind)
    path = output or workspace.root / "pictures" / f"round-{number:02d}-{name}-{policy}.{kind}"
    if path.is_dir() or not path.parent.is_dir():
        raise ConfigError(f"--output {path}: name a file in a folder that exists")
    replace_file(path, content)
    return path


def frame_picture(workspace: Workspace, name: str, round_number: int, policy: str) -> np.ndarray:
    """Return image and bird's eye view of any frame as (height, width, 3) uint8 RGB.

    Raises:
        ConfigError: if no frame has that name.
    """
    return _painted(workspace, name, (round_number, policy), "png", DARK).finish()


def shown_labels(workspace: Workspace, frame: Frame, found: FrameBoxes, policy: str) -> ShownLabels:
    """Return the labels of a frame as pictures show them."""
    labels = found.labels
    return ShownLabels(
        labels.boxes,
        labels.categories,
        labels.scores,
        found.weights,
        count_points_in_boxes(frame.points, labels.boxes),
        zero_weight_of(workspace.config, policy),
        found.numbers,
    )


def draw_labels(workspace: Workspace, round_number: int, name: str) -> list[Path]:
    """Draw a frame's image and its bird's eye view into two files in the folder `pictures`."""
    policy = workspace.config.run.method
    frame = workspace.dataset.read(name, image=True)
    if frame.image is None:
        raise DataError(f"frame {name}: the data set has no image")
    found = read_frame(workspace, name, round_number, policy)
    labels = shown_labels(workspace, frame, found, policy)
    title = f"frame {name}, round {round_number}, weights by {policy}"
    stem = f"round-{round_number:02d}-{name}"
    pictures = {
        f"{stem}-bird-eye.png": draw_bird_eye(frame.points, labels, title=title),
        f"{stem}-image.png": draw_overlay(frame.image, frame.calibration, labels, title=title),
    }
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
    """Draw a frame in a round under a policy."""
    number, policy = weighted
    found = read_frame(workspace, name, number, policy)
    frame = workspace.dataset.read(name, image=True)
    shown = Shown(
        shown_labels(workspace, frame, found, policy),
        found.truth_boxes,
        found.repredictions,
        found.human_boxes,
        picture_title(name, found, number, policy),
        style,
    )
    return paint_frame(frame, shown, kind)


def _most_varied(found: LabelColumns) -> int:
    """Return the frame with most of both trusted and mistrusted labels, the nearer the better."""
    near, count = found.boxes[:, 0] < 40, len(found.frame_names)
    trusted = np.bincount(found.frames[near & (found.weights > 0.3)], minlength=count)
    mistrusted = np.bincount(found.frames[near & (found.weights < 0.1)], minlength=count)
    return int(np.argmax(np.minimum(trusted, mistrusted) + 0.01 * trusted))
