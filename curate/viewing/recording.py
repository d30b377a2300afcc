"""A 3D recording of frames for the rerun viewer: points, image, and boxes coloured by weight.

Format: rerun's .rrd, https://rerun.io. Its time line `frame` counts the recorded frames.
"""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np

from curate.errors import ConfigError, one_line
from curate.frames import Calibration, Frame
from curate.viewing.palette import GROUND_TRUTH, height_shades, weight_colours
from curate.viewing.tags import ShownLabels, ShownRepredictions

POINTS = "world/points"
CAMERA = "world/camera"
PREDICTIONS = "world/predictions"
REPREDICTIONS = "world/repredictions"
TRUTH = "world/ground_truth"
TITLE = "title"
TIMELINE = "frame"

_POINT_RADIUS = 0.03
_LINE_RADII = {PREDICTIONS: 0.04, REPREDICTIONS: 0.015, TRUTH: 0.02}
_JPEG_QUALITY = 90


@dataclass(frozen=True)
class RecordedFrame:
    """What is recorded of one frame.

    Attributes:
        frame: with its image, or without.
        labels: the predictions, coloured by weight.
        evidence: (n,) numbers per prediction by name, NaN where unknown.
        repredictions: in the colour of the label that each was matched with.
        truth_boxes: (m, 7) in the LiDAR frame; None where the ground truth is unknown.
        truth_categories: (m,) str; None likewise.
        title: what the frame is.
    """

    frame: Frame
    labels: ShownLabels
    evidence: Mapping[str, np.ndarray]
    repredictions: ShownRepredictions
    truth_boxes: np.ndarray | None = None
    truth_categories: np.ndarray | None = None
    title: str = ""


def write_recording(path: Path, frames: Iterable[RecordedFrame]) -> int:
    """Write an .rrd file; whole, or not at all.

    Args:
        path: an existing file is replaced.
        frames: taken one after the other, in the order of the time line.

    Returns:
        The number of frames.

    Raises:
        ConfigError: rerun is not installed, or the file cannot be written.
    """
    rerun = load_rerun()
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    stream = rerun.RecordingStream("curate")
    count = 0
    try:
        _open(stream, partial)
        # The viewer opens at the only time line; when something was written is of no interest.
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for recorded in frames:
            stream.set_time(TIMELINE, sequence=count)
            _log_frame(rerun, stream, recorded)
            count += 1
        stream.disconnect()
        partial.replace(path)
    finally:
        stream.disconnect()
        partial.unlink(missing_ok=True)
    return count


def load_rerun() -> ModuleType:
    """Return the package, imported only where a recording is written.

    Raises:
        ConfigError: if it is not installed.
    """
    try:
        import rerun
    except ImportError as error:
        raise ConfigError(
            "recordings need rerun: pip install 'curate-pseudo-labels[rerun]'"
        ) from error
    module: ModuleType = rerun
    return module


def camera_pose(calibration: Calibration) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the camera as a pinhole in the LiDAR frame.

    Returns:
        (3, 3) intrinsics in pixels, (3, 3) rotation from camera to LiDAR frame, and (3,) the
        camera's place in the LiDAR frame, metres.
    """
    projection = calibration.lidar_to_image
    if np.linalg.det(projection[:, :3]) < 0:
        projection = -projection
    intrinsics, rotation, centre = cv2.decomposeProjectionMatrix(projection)[:3]
    signs = np.diag(np.sign(np.diag(intrinsics)))
    intrinsics, rotation = intrinsics @ signs, signs @ rotation
    return intrinsics / intrinsics[2, 2], rotation.T, (centre[:3] / centre[3]).ravel()


def captions(labels: ShownLabels, evidence: Mapping[str, np.ndarray]) -> list[str]:
    """What is written at each label: weight, category, score, points, and the evidence."""
    lines = []
    for i in range(len(labels)):
        known = {name: values[i] for name, values in evidence.items() if np.isfinite(values[i])}
        shown = "  ".join(f"{name} {value:.3g}" for name, value in known.items())
        weight = f"  weight {labels.weights[i]:.2f}" if labels.weights[i] > 0 else ""
        words = [f"k {labels.number(i)}{weight}", labels.details(i), shown]
        lines.append("\n".join(filter(None, words)))
    return lines


def _open(stream: Any, path: Path) -> None:
    """Let the stream write into a file; RERUN=off in the environment would silence it."""
    try:
        stream.save(path, default_blueprint=_blueprint())
    except (OSError, RuntimeError) as error:
        raise ConfigError(
            f"{path.parent}: no recording can be written there: {one_line(error)}"
        ) from error
    if not path.exists():
        raise ConfigError("rerun is switched off: unset the environment variable RERUN")


def _log_frame(rerun: ModuleType, stream: Any, recorded: RecordedFrame) -> None:
    frame, labels = recorded.frame, recorded.labels
    stream.log(TITLE, rerun.TextDocument(recorded.title))
    positions = frame.points[:, :3]
    shades = height_shades(positions[:, 2])
    stream.log(POINTS, rerun.Points3D(positions, colors=shades, radii=_POINT_RADIUS))
    _log_camera(rerun, stream, frame)
    if len(labels):
        words = captions(labels, recorded.evidence)
        boxes = _boxes(rerun, PREDICTIONS, labels.boxes, weight_colours(labels.weights), words)
        numbers = {"weight": labels.weights, "score": labels.scores, **recorded.evidence}
        stream.log(PREDICTIONS, boxes, rerun.AnyValues(**numbers))
    else:
        stream.log(PREDICTIONS, rerun.Clear(recursive=False))
    again = recorded.repredictions
    colours = weight_colours(again.weights)
    stream.log(REPREDICTIONS, _boxes(rerun, REPREDICTIONS, again.boxes, colours, []))
    truth = np.zeros((0, 7)) if recorded.truth_boxes is None else recorded.truth_boxes
    seen = ~np.isnan(truth).any(axis=1)
    names = [] if recorded.truth_categories is None else recorded.truth_categories[seen].tolist()
    white = np.tile(np.array(GROUND_TRUTH, dtype=np.uint8), (int(seen.sum()), 1))
    stream.log(TRUTH, _boxes(rerun, TRUTH, truth[seen], white, names))


def _log_camera(rerun: ModuleType, stream: Any, frame: Frame) -> None:
    """The pinhole where it stands, and its image."""
    if frame.image is None:
        return
    intrinsics, rotation, centre = camera_pose(frame.calibration)
    stream.log(CAMERA, rerun.Transform3D(translation=centre, mat3x3=rotation))
    pinhole = rerun.Pinhole(image_from_camera=intrinsics, resolution=frame.image_size)
    stream.log(CAMERA, pinhole)
    pixels = cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR)
    _, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    image = rerun.EncodedImage(contents=content.tobytes(), media_type="image/jpeg")
    stream.log(f"{CAMERA}/image", image)


def _boxes(
    rerun: ModuleType, place: str, boxes: np.ndarray, colours: np.ndarray, names: list[str]
) -> Any:
    """Return (n, 7) boxes; none at all empties what an earlier frame left at the same place."""
    half = boxes[:, 6] / 2
    nothing = np.zeros(len(boxes))
    return rerun.Boxes3D(
        centers=boxes[:, :3],
        half_sizes=boxes[:, 3:6] / 2,
        quaternions=np.column_stack([nothing, nothing, np.sin(half), np.cos(half)]),
        colors=colours,
        radii=np.full(len(boxes), _LINE_RADII[place]),
        labels=names,
    )


def _blueprint() -> Any:
    """How the viewer lays the recording out: the world on top, the image below."""
    from rerun import blueprint

    boxes = [f"/{place}" for place in (PREDICTIONS, REPREDICTIONS, TRUTH)]
    return blueprint.Blueprint(
        blueprint.Vertical(
            blueprint.Spatial3DView(origin="/world", name="LiDAR"),
            blueprint.Horizontal(
                blueprint.Spatial2DView(
                    origin=f"/{CAMERA}", contents=[f"/{CAMERA}/**", *boxes], name="Camera"
                ),
                blueprint.TextDocumentView(origin=f"/{TITLE}", name="Frame"),
                column_shares=[4, 1],
            ),
            row_shares=[3, 2],
        ),
        collapse_panels=True,
    )
