"""Copies of all frames of a data set, opened as a data set again."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from curate.datasets.base import Dataset
from curate.datasets.copies import CopyWriter, copy_writer
from curate.frames import Frame
from curate.geometry.projection import project_points
from curate.geometry.similarity import Similarity
from pipelines.registry import DATASETS

TURNED = Similarity(flip_y=True, rotation_rad=np.pi / 4, scale=1.05)


def write_all(writer: CopyWriter) -> None:
    """Write the copies of all frames."""
    writer.prepare()
    for frame_id in writer.frame_ids:
        assert not writer.is_written(frame_id)
        writer.write(frame_id)
        assert writer.is_written(frame_id)


def copied(
    dataset: Dataset, folder: Path, copies: Mapping[str, Similarity | None]
) -> tuple[Dataset, CopyWriter]:
    """Return the copies as a data set, and their writer."""
    writer = copy_writer(dataset, folder, copies)
    write_all(writer)
    options = {"layout": dataset.layout} if writer.kind == "kitti" else {}
    return DATASETS.build(writer.kind, folder, offered={}, options=options), writer


def assert_is_copy(copy: Frame, frame: Frame, similarity: Similarity) -> None:
    """Check that points are A(x), and that they are projected to the pixels of x."""
    assert copy.frame_id == frame.frame_id
    moved = similarity.apply_to_points(frame.points)
    np.testing.assert_allclose(copy.points, moved, rtol=1e-6, atol=1e-5)
    np.testing.assert_array_equal(copy.points[:, 3], frame.points[:, 3])
    assert [camera.name for camera in copy.cameras] == [camera.name for camera in frame.cameras]
    exact = frame.points.astype(np.float64)
    for one, other in zip(copy.cameras, frame.cameras, strict=True):
        assert one.image_size == other.image_size
        pixels, depth = project_points(similarity.apply_to_points(exact), one.calibration)
        expected, original = project_points(exact, other.calibration)
        seen = original > 0.1
        np.testing.assert_allclose(depth, original * similarity.scale, atol=1e-9)
        np.testing.assert_allclose(pixels[seen], expected[seen], rtol=1e-9, atol=1e-6)
