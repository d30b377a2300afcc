"""The frame, boxes and classes with which the files on the page Input formats are read."""

import numpy as np

from curate.frames import Calibration, Frame

SIZE = (120, 40)
CLASSES = {"Car": (3,), "Pedestrian": (1,)}
BOXES = np.array([[10.0, 1, -1, 4, 1.8, 1.6, 0.1], [15.0, -2, -1, 0.8, 0.6, 1.7, 0.5]])


def frame(name: str = "000001") -> Frame:
    """Return a frame without points, with a black image."""
    projection = np.array([[60.0, 0, 60, 0], [0, 60, 20, 0], [0, 0, 1, 0]])
    lidar_to_camera = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    image = np.zeros((40, 120, 3), dtype=np.uint8)
    calibration = Calibration(projection, lidar_to_camera)
    return Frame(name, np.zeros((0, 4), np.float32), calibration, SIZE, image)
