"""Random rigs and boxes: a camera with any mounting, a LiDAR anywhere on a map."""

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from oracles.camera_boxes import mounted
from scipy.spatial.transform import Rotation

from curate.detections import Detections, as_categories
from curate.frames import Calibration, Frame

NAMES = ("Car", "Pedestrian", "Cyclist")
IMAGE_SIZE = (1200, 360)


@dataclass(frozen=True)
class Rig:
    """The poses of the sensors.

    Attributes:
        yaw: azimuth of the camera in the LiDAR frame, radians.
        pitch: of the optical axis, downwards.
        roll: about the optical axis.
        origin: (3,) the LiDAR in the camera frame.
        to_map: rotation from LiDAR to map, and the LiDAR's position.
    """

    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    origin: tuple[float, float, float] = (0.1, -0.2, -0.3)
    to_map: tuple[Rotation, np.ndarray] = (Rotation.identity(), np.zeros(3))

    @property
    def turn(self) -> Rotation:
        """Return the rotation from LiDAR to camera."""
        return mounted(self.yaw, self.pitch, self.roll)

    @property
    def upside_down(self) -> bool:
        """Return whether the camera's y axis points up."""
        return bool(np.cos(self.pitch) * np.cos(self.roll) < 0)

    @property
    def calibration(self) -> Calibration:
        """Return the same as matrices."""
        projection = np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]])
        camera, place = np.eye(4), np.eye(4)
        for matrix, (turn, origin) in (
            (camera, (self.turn, np.array(self.origin))),
            (place, self.to_map),
        ):
            matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), origin
        return Calibration(projection, camera, place)

    def frame(self, name: str) -> Frame:
        """Return a frame without points."""
        return Frame(name, np.zeros((0, 4), np.float32), self.calibration, IMAGE_SIZE)


FORWARD, LEFT, REAR = Rig(), Rig(yaw=np.pi / 2), Rig(yaw=np.pi)
TILTED, UPSIDE_DOWN = Rig(pitch=0.21), Rig(yaw=0.4, pitch=-0.1, roll=np.pi)

offsets = st.tuples(*[st.floats(-2.0, 2.0)] * 3)
slopes = st.tuples(*[st.floats(-0.05, 0.05)] * 2)
rigs = st.builds(
    lambda yaw, pitch, roll, origin, heading, slope, place: Rig(
        yaw, pitch, roll, origin,
        (Rotation.from_euler("zyx", [heading, *slope]), np.array(place) * [450, 450, 1]),
    ),
    st.floats(-np.pi, np.pi), st.floats(-1.3, 1.3),
    # Within 80 degrees of upright or upside down; on its side, a camera defines no heading.
    st.floats(-1.2, 1.2) | st.floats(np.pi - 1.2, np.pi + 1.2),
    offsets, st.floats(-3.1, 3.1), slopes, offsets,
)  # fmt: skip

_boxes = st.tuples(
    st.floats(-60, 60), st.floats(-30, 30), st.floats(-3, 3),
    st.floats(2.1, 9), st.floats(0.3, 2.0), st.floats(0.3, 4),
    st.floats(-np.pi, np.pi, exclude_min=True),
)  # fmt: skip
detections = st.lists(
    st.tuples(_boxes, st.floats(0.01, 1), st.sampled_from(NAMES)),
    min_size=1,
    max_size=5,
    unique_by=lambda row: round(row[0][0], 3),  # duplicate boxes are rejected
).map(
    lambda rows: Detections(
        np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]),
        as_categories([row[2] for row in rows]),
    )
)


def assert_equal_boxes(one: np.ndarray, other: np.ndarray, atol: float = 1e-6) -> None:
    """Check equality of (n, 7) boxes in metres and radians; yaw is compared as a direction."""
    np.testing.assert_allclose(one[:, :6], other[:, :6], atol=atol)
    np.testing.assert_allclose(np.sin((one[:, 6] - other[:, 6]) / 2), 0, atol=atol)
