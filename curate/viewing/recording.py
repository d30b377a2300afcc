"""Write a 3D recording of frames for the rerun viewer: points, image, boxes coloured by weight.

Format: rerun's .rrd, https://rerun.io. The timeline `frame` counts the recorded frames.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np

from curate.errors import ConfigError, one_line
from curate.frames import Calibration, Camera, Frame
from curate.viewing.palette import DARK, height_shades, weight_colours
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
    """The recorded data of one frame.

    Attributes:
        frame: a frame with or without its image.
        labels: the labels, coloured by weight; those of people in their own colour.
        evidence: (n,) numbers per prediction, by name; NaN if unknown.
        repredictions: repredictions, each in the colour of its matched label.
        truth_boxes: (m, 7) ground truth in the LiDAR frame; None if unknown.
        truth_categories: (m,) str; None if unknown.
        title: description of the frame.
    """

    frame: Frame
    labels: ShownLabels
    evidence: Mapping[str, np.ndarray]
    repredictions: ShownRepredictions
    truth_boxes: np.ndarray | None = None
    truth_categories: np.ndarray | None = None
    title: str = ""


def write_recording(path: Path, frames: Iterable[RecordedFrame]) -> int:
    """Write an .rrd file atomically.

    Args:
        path: path of the file; an existing file is replaced.
        frames: the frames in the order of the timeline, read one after the other.

    Returns:
        The number of frames.

    Raises:
        ConfigError: if rerun is not installed, or the file cannot be written.
    """
    rerun = load_rerun()
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    stream = rerun.RecordingStream("curate")
    count = 0
    try:
        frames = iter(frames)
        first = list(islice(frames, 1))
        _open(stream, partial, first[0].frame.cameras if first else ())
        # With `frame` as the only timeline, the viewer opens with it.
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for recorded in chain(first, frames):
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
    """Import and return the package rerun, which is optional.

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
        (3, 3) intrinsics in pixels, (3, 3) rotation from the camera to the LiDAR frame, and (3,)
        the position of the camera in the LiDAR frame, in metres.
    """
    projection = calibration.lidar_to_image
    if np.linalg.det(projection[:, :3]) < 0:
        projection = -projection
    intrinsics, rotation, centre = cv2.decomposeProjectionMatrix(projection)[:3]
    signs = np.diag(np.sign(np.diag(intrinsics)))
    intrinsics, rotation = intrinsics @ signs, signs @ rotation
    return intrinsics / intrinsics[2, 2], rotation.T, (centre[:3] / centre[3]).ravel()


def captions(labels: ShownLabels, evidence: Mapping[str, np.ndarray]) -> list[str]:
    """Return the text at each label: weight, category, score, points and evidence."""
    lines = []
    for i in range(len(labels)):
        defined = {name: values[i] for name, values in evidence.items() if np.isfinite(values[i])}
        numbers = "  ".join(f"{name} {value:.3g}" for name, value in defined.items())
        weight = f"  weight {labels.weights[i]:.2f}" if labels.weights[i] > 0 else ""
        parts = [f"k {labels.number(i)}{weight}", labels.details(i), numbers]
        lines.append("\n".join(filter(None, parts)))
    return lines


def _open(stream: Any, path: Path, cameras: Sequence[Camera]) -> None:
    """Open a file for the stream; with RERUN=off in the environment rerun writes nothing."""
    try:
        stream.save(path, default_blueprint=_blueprint(cameras))
    except (OSError, RuntimeError) as error:
        raise ConfigError(
            f"{path.parent}: a recording cannot be written there: {one_line(error)}"
        ) from error
    if not path.exists():
        raise ConfigError("rerun is disabled: unset the environment variable RERUN")


def _log_frame(rerun: ModuleType, stream: Any, recorded: RecordedFrame) -> None:
    frame, labels = recorded.frame, recorded.labels
    stream.log(TITLE, rerun.TextDocument(recorded.title))
    positions = frame.points[:, :3]
    shades = height_shades(positions[:, 2])
    stream.log(POINTS, rerun.Points3D(positions, colors=shades, radii=_POINT_RADIUS))
    for camera in frame.cameras:
        _log_camera(rerun, stream, camera)
    if len(labels):
        words = captions(labels, recorded.evidence)
        colours = weight_colours(labels.weights)
        colours[labels.is_human] = DARK.human
        boxes = _boxes(rerun, PREDICTIONS, labels.boxes, colours, words)
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
    white = np.tile(np.array(DARK.ground_truth, dtype=np.uint8), (int(seen.sum()), 1))
    stream.log(TRUTH, _boxes(rerun, TRUTH, truth[seen], white, names))


def _log_camera(rerun: ModuleType, stream: Any, camera: Camera) -> None:
    """Log the pose of a camera, its intrinsics and its image."""
    if camera.image is None:
        return
    place = _place(camera)
    intrinsics, rotation, centre = camera_pose(camera.calibration)
    stream.log(place, rerun.Transform3D(translation=centre, mat3x3=rotation))
    pinhole = rerun.Pinhole(image_from_camera=intrinsics, resolution=camera.image_size)
    stream.log(place, pinhole)
    pixels = cv2.cvtColor(camera.image, cv2.COLOR_RGB2BGR)
    _, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    image = rerun.EncodedImage(contents=content.tobytes(), media_type="image/jpeg")
    stream.log(f"{place}/image", image)


def _place(camera: Camera) -> str:
    """Return the entity of a camera."""
    return f"{CAMERA}/{camera.name}" if camera.name else CAMERA


def _boxes(
    rerun: ModuleType, place: str, boxes: np.ndarray, colours: np.ndarray, names: list[str]
) -> Any:
    """Return (n, 7) boxes for rerun; an empty array clears the boxes of earlier frames."""
    half = boxes[:, 6] / 2
    zeros = np.zeros(len(boxes))
    return rerun.Boxes3D(
        centers=boxes[:, :3],
        half_sizes=boxes[:, 3:6] / 2,
        quaternions=np.column_stack([zeros, zeros, np.sin(half), np.cos(half)]),
        colors=colours,
        radii=np.full(len(boxes), _LINE_RADII[place]),
        labels=names,
    )


def _blueprint(cameras: Sequence[Camera]) -> Any:
    """Return the layout of the viewer: the LiDAR view on top, the images below."""
    from rerun import blueprint

    boxes = [f"/{place}" for place in (PREDICTIONS, REPREDICTIONS, TRUTH)]
    return blueprint.Blueprint(
        blueprint.Vertical(
            blueprint.Spatial3DView(origin="/world", name="LiDAR"),
            blueprint.Horizontal(
                *(
                    blueprint.Spatial2DView(
                        origin=f"/{place}",
                        contents=[f"/{place}/**", *boxes],
                        name=camera.name or "Camera",
                    )
                    for camera in cameras
                    for place in [_place(camera)]
                ),
                blueprint.TextDocumentView(origin=f"/{TITLE}", name="Frame"),
                column_shares=[*([4] * len(cameras)), 1],
            ),
            row_shares=[3, 2],
        ),
        collapse_panels=True,
    )
