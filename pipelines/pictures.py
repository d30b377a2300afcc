"""Pictures of a frame's weighted labels."""

from pathlib import Path

from curate.errors import DataError
from curate.viewing.bird_eye import draw_bird_eye
from curate.viewing.canvas import save_png
from curate.viewing.overlay import draw_overlay
from curate.viewing.tags import ShownLabels
from pipelines.labels import FrameLabels, read_labels
from pipelines.workspace import Workspace


def draw_telling_frame(workspace: Workspace, round_number: int) -> list[Path]:
    """A bird's eye view and an image overlay of the frame that shows most of all weights."""
    policy = workspace.config.run.method
    frames = list(read_labels(workspace, round_number, policy))
    shown = max(frames, key=_variety)
    return draw_labels(workspace, round_number, shown)


def draw_labels(workspace: Workspace, round_number: int, shown: FrameLabels) -> list[Path]:
    """Both pictures of a frame, in the folder `pictures`."""
    frame = workspace.dataset.read(shown.frame, image=True)
    if frame.image is None:
        raise DataError(f"frame {shown.frame}: the data set has no image")
    labels = ShownLabels(
        shown.labels.boxes,
        shown.labels.categories,
        shown.labels.scores,
        shown.weights,
        shown.points,
    )
    title = f"frame {shown.frame}, round {round_number}, weights by {workspace.config.run.method}"
    stem = f"round-{round_number:02d}-{shown.frame}"
    pictures = {
        f"{stem}-bird-eye.png": draw_bird_eye(frame.points, labels, title=title),
        f"{stem}-image.png": draw_overlay(frame.image, frame.calibration, labels, title=title),
    }
    folder = workspace.root / "pictures"
    for name, picture in pictures.items():
        save_png(folder / name, picture)
    return [folder / name for name in pictures]


def _variety(shown: FrameLabels) -> float:
    """How much a frame has of both trusted and mistrusted labels, the nearer the better."""
    near = shown.labels.boxes[:, 0] < 40
    trusted = (shown.weights[near] > 0.3).sum()
    mistrusted = (shown.weights[near] < 0.1).sum()
    return float(min(trusted, mistrusted) + 0.01 * trusted)
