"""Pictures of a frame's weighted labels."""

from pathlib import Path

import numpy as np

from curate.errors import ConfigError, DataError
from curate.geometry.points_in_boxes import count_points_in_boxes
from curate.viewing.bird_eye import draw_bird_eye
from curate.viewing.canvas import save_png
from curate.viewing.frame_view import draw_frame
from curate.viewing.overlay import draw_overlay
from curate.viewing.tags import ShownLabels
from pipelines.labels.columns import LabelColumns, read_columns
from pipelines.labels.of_one_frame import FrameBoxes, chosen_round, read_frame
from pipelines.stages.methods import zero_weight_of
from pipelines.workspace.workspace import Workspace


def draw_example_frame(workspace: Workspace, round_number: int) -> list[Path]:
    """A bird's eye view and an image overlay of the frame that shows most of all weights."""
    policy = workspace.config.run.method
    found = read_columns(workspace, round_number, policy)
    place = _most_varied(found)
    name, own = found.frame_names[place], found.frames == place
    frame = workspace.dataset.read(name, image=True)
    if frame.image is None:
        raise DataError(f"frame {name}: the data set has no image")
    points = found.numbers["points"][own]
    labels = ShownLabels(
        found.boxes[own],
        np.array(found.category_names)[found.categories[own]],
        found.numbers["score"][own],
        found.weights[own],
        None if np.isnan(points).any() else points.astype(np.int64),
        zero_weight_of(workspace.config, policy),
    )
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


def draw_view(
    workspace: Workspace,
    name: str,
    round_number: int | None = None,
    policy: str | None = None,
    output: Path | None = None,
) -> Path:
    """Image and bird's eye view of any frame in one picture; says where it is.

    Args:
        workspace: see `Workspace`.
        name: of the frame.
        round_number: None for the last that has predictions.
        policy: whose weights; None for the configured one.
        output: None for a file in the folder `pictures`.

    Raises:
        ConfigError: no frame has that name, or a picture cannot be written to `output`.
        WorkspaceError: the round has no predictions.
    """
    number = chosen_round(workspace, round_number)
    policy = policy or workspace.config.run.method
    picture = frame_picture(workspace, name, number, policy)
    path = output or workspace.root / "pictures" / f"round-{number:02d}-{name}-{policy}.png"
    if path.is_dir() or not path.parent.is_dir():
        raise ConfigError(f"--output {path}: name a file in a folder that exists")
    save_png(path, picture)
    return path


def frame_picture(workspace: Workspace, name: str, round_number: int, policy: str) -> np.ndarray:
    """Image and bird's eye view of any frame as (height, width, 3) uint8 RGB.

    Raises:
        ConfigError: no frame has that name.
    """
    found = read_frame(workspace, name, round_number, policy)
    frame = workspace.dataset.read(name, image=True)
    counts = count_points_in_boxes(frame.points, found.labels.boxes)
    labels = shown_labels(workspace, policy, found, counts)
    title = f"frame {name} ({found.split}), round {round_number}, weights by {policy}"
    return draw_frame(
        frame,
        labels,
        found.truth_boxes,
        found.repredictions,
        human_boxes=found.human_boxes,
        title=title,
    )


def shown_labels(
    workspace: Workspace, policy: str, found: FrameBoxes, points: np.ndarray
) -> ShownLabels:
    """Return the labels of a frame as pictures show them, with the (n,) points in each."""
    labels, meaning = found.labels, zero_weight_of(workspace.config, policy)
    return ShownLabels(
        labels.boxes, labels.categories, labels.scores, found.weights, points, meaning
    )


def _most_varied(found: LabelColumns) -> int:
    """The frame with most of both trusted and mistrusted labels, the nearer the better."""
    near, count = found.boxes[:, 0] < 40, len(found.frame_names)
    trusted = np.bincount(found.frames[near & (found.weights > 0.3)], minlength=count)
    mistrusted = np.bincount(found.frames[near & (found.weights < 0.1)], minlength=count)
    return int(np.argmax(np.minimum(trusted, mistrusted) + 0.01 * trusted))
