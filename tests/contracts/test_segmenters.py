"""The contract of every registered segmenter."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from contracts.samples import assert_one_line, sample_of

from curate.detections import CATEGORIES
from curate.errors import DataError, ModelError
from curate.frames import Frame
from curate.segmenters.classes import class_map
from pipelines.assembly import SHIPPED_SEGMENTER
from pipelines.registry import SEGMENTERS


def write_maps(folder: Path, frames: Sequence[Frame]) -> Path:
    """Write a semantic map per frame: rectangles of all classes."""
    for number, frame in enumerate(frames):
        width, height = frame.image_size
        class_ids = np.zeros((height, width), dtype=np.uint8)
        for class_id in (1, 2, 3):
            left = 30 * class_id + 5 * number
            class_ids[5:35, left : left + 20] = class_id
        cv2.imwrite(str(folder / f"{frame.frame_id}.png"), class_ids)
    return folder


def write_instances(folder: Path, frames: Sequence[Frame]) -> Path:
    """Write a file of instance masks: a rectangle per class."""
    polygons = [[left, 5, left + 20, 5, left + 20, 35, left, 35] for left in (30, 60, 90)]
    objects = [
        {"image_id": frame.frame_id, "category_id": class_id, "segmentation": [polygon]}
        for frame in frames
        for class_id, polygon in enumerate(polygons, start=1)
    ]
    path = folder / "instances.json"
    path.write_text(json.dumps(objects))
    return path


def write_instance_model(folder: Path, frames: Sequence[Frame]) -> Path:
    """Write a model that predicts a rectangle per class for every image."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    found = {
        "boxes": np.float32([[30 * one, 5, 30 * one + 20, 35] for one in (1, 2, 3)]),
        "labels": np.array([1, 2, 3]),
        "scores": np.float32([0.9, 0.8, 0.7]),
        "masks": np.ones((3, 1, 28, 28), np.float32),
    }
    nodes = [
        helper.make_node("Constant", [], [name], value=numpy_helper.from_array(values))
        for name, values in found.items()
    ]
    outputs = [
        helper.make_tensor_value_info(
            name, TensorProto.INT64 if name == "labels" else TensorProto.FLOAT, values.shape
        )
        for name, values in found.items()
    ]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, None, None])
    graph = helper.make_graph(nodes, "toy", [image], outputs)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    path = folder / "instances.onnx"
    onnx.save(model, path)
    return path


# Write the file or folder from which the segmenter is created, for the test frames.
SAMPLES: Mapping[str, Callable[[Path, Sequence[Frame]], Path]] = {
    "onnx": lambda folder, frames: SHIPPED_SEGMENTER,
    "onnx-instances": write_instance_model,
    "saved": write_maps,
    "degraded": write_maps,
    "instances": write_instances,
}


def build(name: str, path: Path):
    """Return a segmenter as the pipeline builds it."""
    offered = {"classes": lambda: class_map("simulated"), "seed": lambda: 0}
    return SEGMENTERS.build(name, path, offered=offered, options={})


@pytest.fixture(scope="module", params=sorted(SEGMENTERS.classes))
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, frames):
    """Return the name and the file of every registered segmenter in turn."""
    description = (
        "a function that gives a small file or folder from which the segmenter can be made"
    )
    prepare = sample_of(SAMPLES, request.param, description)
    return request.param, prepare(tmp_path_factory.mktemp(request.param), frames)


@pytest.fixture(scope="module")
def segmenter(made):
    """Return every registered segmenter with its default settings."""
    return build(*made)


def segmenter_input(segmenter, frame: Frame) -> Frame:
    """Return the frame as the pipeline reads it for a segmenter."""
    return frame if segmenter.needs_image else replace(frame, image=None)


def test_a_map_has_a_class_for_every_pixel(segmenter, frames) -> None:
    """Its type is uint8, its shape that of the image."""
    assert isinstance(segmenter.needs_image, bool)
    for frame in frames:
        width, height = frame.image_size
        found = segmenter.segment(segmenter_input(segmenter, frame))
        assert (found.class_ids.shape, found.class_ids.dtype) == ((height, width), np.uint8)


def test_every_category_has_its_classes(segmenter, frames) -> None:
    """Tuples with at least one id in [0, 255]."""
    classes = segmenter.segment(segmenter_input(segmenter, frames[0])).category_classes
    for category in CATEGORIES:
        ids = classes[category]
        assert isinstance(ids, tuple)
        assert ids
        assert all(isinstance(one, int) and 0 <= one <= 255 for one in ids)


def test_maps_do_not_depend_on_earlier_calls(made, segmenter, frames) -> None:
    """A second call, another order or another instance gives the same pixels."""
    seen = [segmenter_input(segmenter, frame) for frame in frames]
    before = [segmenter.segment(frame).class_ids.copy() for frame in seen]
    other = build(*made)
    for frame, expected in reversed(list(zip(seen, before, strict=True))):
        np.testing.assert_array_equal(other.segment(frame).class_ids, expected)
        np.testing.assert_array_equal(segmenter.segment(frame).class_ids, expected)


def test_a_map_that_is_stored_depends_on_the_image_alone(segmenter, frames) -> None:
    """Not on the name of the frame, its camera, its points or its calibration."""
    if segmenter.map_version is None:
        return
    assert isinstance(segmenter.map_version, int)
    one, other = frames[:2]
    renamed = replace(other, image=one.image, image_size=one.image_size, camera="other")
    np.testing.assert_array_equal(
        segmenter.segment(renamed).class_ids, segmenter.segment(one).class_ids
    )


def test_a_frame_is_not_modified_and_its_points_are_not_used(segmenter, frames) -> None:
    """The image is read-only, and there are no points."""
    image = frames[0].image.copy()
    image.flags.writeable = False
    frame = replace(frames[0].with_points(frames[0].points[:0]), image=image)
    found = segmenter.segment(frame).class_ids
    np.testing.assert_array_equal(
        found, segmenter.segment(segmenter_input(segmenter, frames[0])).class_ids
    )
    np.testing.assert_array_equal(image, frames[0].image)


def test_a_frame_without_image_or_map_is_reported(segmenter, frames) -> None:
    """The error is one line with the frame's name."""
    with pytest.raises((ModelError, DataError), match="999999") as caught:
        segmenter.segment(replace(frames[0], frame_id="999999", image=None))
    assert_one_line(caught.value)


@pytest.mark.parametrize("content", [None, b"no model \x00\xff\n"])
def test_an_invalid_segmenter_file_is_rejected(made, tmp_path: Path, content: bytes | None) -> None:
    """A missing or random file gives a one-line error of the right class."""
    broken = tmp_path / "broken.onnx"
    if content is not None:
        broken.write_bytes(content)
    with pytest.raises((ModelError, DataError), match=r"broken\.onnx") as caught:
        build(made[0], broken)
    assert_one_line(caught.value)
