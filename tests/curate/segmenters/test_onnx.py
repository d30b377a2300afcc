"""The ONNX segmenter with handmade models, and DeepLab v3 on one real frame."""

from dataclasses import replace

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnxruntime import InferenceSession
from support.fatal_files import write_overflowing_model
from support.tiny_onnx import constant_model as constant_outputs
from support.toys import toy_calibration

from curate.errors import ConfigError, ModelError
from curate.files.onnx_session import OnnxModel
from curate.frames import Frame
from curate.segmenters.classes import class_map
from curate.segmenters.onnx import OnnxSegmenter, cut_along

CLASSES = {"Car": (7,), "Pedestrian": (15,)}


def model(path, nodes, shape, kind, constants=(), *, answer=TensorProto.INT64, rank=3, more=()):
    """Save a model from `image` to `answer`."""
    inputs = [helper.make_tensor_value_info("image", kind, shape), *more]
    output = helper.make_tensor_value_info("answer", answer, [None] * rank)
    graph = helper.make_graph(
        nodes, "toy", inputs, [output], [numpy_helper.from_array(v, n) for n, v in constants]
    )
    opsets = [helper.make_opsetid("", 18)]
    onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=10), path)
    return path


def red_channel_model(path, shape):
    """Save a uint8 NHWC model; the class id of a pixel is its red channel."""
    nodes = [
        helper.make_node("Gather", ["image", "zero"], ["red"], axis=3),
        helper.make_node("Cast", ["red"], ["answer"], to=TensorProto.INT64),
    ]
    return model(path, nodes, shape, TensorProto.UINT8, [("zero", np.array(0))])


def brightest_channel_model(path, shape, *, channels_last=False):
    """Save a float NCHW model; scores of three classes are the channels as the model sees them."""
    if channels_last:
        nodes = [helper.make_node("Transpose", ["image"], ["answer"], perm=[0, 2, 3, 1])]
    else:
        nodes = [helper.make_node("Identity", ["image"], ["answer"])]
    return model(path, nodes, shape, TensorProto.FLOAT, answer=TensorProto.FLOAT, rank=4)


def one_step_model(path, node, answer):
    """Save a model with one operator on a float image of 8 x 8 pixels."""
    return model(path, [node], [1, 3, 8, 8], TensorProto.FLOAT, answer=answer, rank=4)


def constant_model(path, class_ids):
    """Save a uint8 NHWC model; the same class ids for every image."""
    height, width = class_ids.shape
    nodes = [
        helper.make_node("ReduceMax", ["image", "axes"], ["most"], keepdims=1),
        helper.make_node("Cast", ["most"], ["number"], to=TensorProto.INT64),
        helper.make_node("Mul", ["number", "zero"], ["nothing"]),
        helper.make_node("Squeeze", ["nothing", "last"], ["flat"]),
        helper.make_node("Add", ["flat", "ids"], ["answer"]),
    ]
    constants = [
        ("axes", np.array([1, 2, 3])), ("zero", np.array(0)), ("last", np.array([3])),
        ("ids", class_ids[None].astype(np.int64)),
    ]  # fmt: skip
    return model(path, nodes, [1, height, width, 3], TensorProto.UINT8, constants)


def frame(image):
    """Return a frame with an image and nothing else."""
    size = (image.shape[1], image.shape[0])
    return Frame("000001", np.zeros((0, 4), np.float32), toy_calibration(), size, image)


def banded(height, width, bands):
    """Return an image with a constant red channel in vertical bands of equal width."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.repeat(bands, -(-width // len(bands)))[:width]
    return image


@pytest.mark.parametrize("shape", [[1, 20, 60, 3], [1, None, None, 3], ["n", "h", "w", 3]])
@pytest.mark.parametrize("size", [(40, 120), (20, 60), (13, 31)])
def test_whole_images_in_a_fixed_or_free_size(tmp_path, shape, size):
    """The map has the size of the image, and each class is at its position."""
    segmenter = OnnxSegmenter(red_channel_model(tmp_path / "a.onnx", shape), CLASSES)
    image = banded(*size, [7, 0, 15])
    found = segmenter.segment(frame(image))
    assert found.class_ids.shape == size
    assert found.class_ids.dtype == np.uint8
    assert found.category_classes == CLASSES
    for share, one in ((0.15, 7), (0.5, 0), (0.85, 15)):
        assert (found.class_ids[:, int(share * size[1])] == one).all()


def test_a_square_model_sees_a_wide_image_in_crops(tmp_path):
    """Bands that one squeezed pass would blur are resolved."""
    path = red_channel_model(tmp_path / "a.onnx", [1, 32, 32, 3])
    image = banded(32, 160, [7, 0] * 40)
    cropped = OnnxSegmenter(path, CLASSES).segment(frame(image)).class_ids
    np.testing.assert_array_equal(cropped, image[..., 0])
    squeezed = OnnxSegmenter(path, CLASSES, tiles=1).segment(frame(image)).class_ids
    assert (squeezed != image[..., 0]).mean() > 0.2


def test_crops_cover_the_image_and_own_the_nearest_columns():
    """Owned columns are a partition; each belongs to the crop with the nearest centre."""
    crops = cut_along(1242, 375, 5)
    assert crops[0].own_left == crops[0].left == 0
    assert crops[-1].own_right == crops[-1].right == 1242
    centres = np.array([(crop.left + crop.right) / 2 for crop in crops])
    for index, crop in enumerate(crops):
        assert crop.left <= crop.own_left < crop.own_right <= crop.right
        assert crop.right - crop.left == 375
        for column in (crop.own_left, crop.own_right - 1):
            distance = np.abs(centres - (column + 0.5))
            assert distance[index] <= distance.min() + 1
    assert [crop.own_right for crop in crops[:-1]] == [crop.own_left for crop in crops[1:]]


def test_more_crops_are_used_if_two_do_not_cover(tmp_path):
    """An image of 10 : 1 is covered by ten square crops."""
    path = red_channel_model(tmp_path / "a.onnx", [1, 16, 16, 3])
    image = banded(16, 160, [7, 15] * 10)
    found = OnnxSegmenter(path, CLASSES, tiles=2).segment(frame(image)).class_ids
    np.testing.assert_array_equal(found, image[..., 0])


@pytest.mark.parametrize("kind", ["uint8", "float"])
def test_crops_go_through_a_model_with_a_free_batch_axis_as_one_batch(tmp_path, monkeypatch, kind):
    """The model runs once per image, and the map is that of a model of batches of 1."""
    make = red_channel_model if kind == "uint8" else brightest_channel_model
    shapes = {
        free: [free, 16, 16, 3] if kind == "uint8" else [free, 3, 16, 16] for free in ("n", 1)
    }
    image = np.random.default_rng(0).integers(0, 256, (16, 70, 3), dtype=np.uint8)
    runs = []
    real = OnnxModel.run

    def run(model, inputs, outputs=None):
        runs.append(len(inputs["image"]))
        return real(model, inputs, outputs)

    monkeypatch.setattr(OnnxModel, "run", run)
    maps = [
        OnnxSegmenter(make(tmp_path / f"{free}.onnx", shape), CLASSES).segment(frame(image))
        for free, shape in shapes.items()
    ]
    np.testing.assert_array_equal(*(found.class_ids for found in maps))
    assert runs == [5, 1, 1, 1, 1, 1]


def test_a_model_whose_inside_takes_one_image_gets_one_after_the_other(tmp_path):
    """Its input declares a free batch axis, but it is reshaped to one image."""
    nodes = [
        helper.make_node("Reshape", ["image", "one"], ["single"]),
        helper.make_node("Gather", ["single", "zero"], ["red"], axis=3),
        helper.make_node("Cast", ["red"], ["answer"], to=TensorProto.INT64),
    ]
    constants = [("one", np.array([1, 16, 16, 3])), ("zero", np.array(0))]
    shape = ["n", 16, 16, 3]
    path = model(tmp_path / "a.onnx", nodes, shape, TensorProto.UINT8, constants)
    segmenter = OnnxSegmenter(path, CLASSES)
    image = banded(16, 64, [7, 15] * 4)
    for _ in range(2):
        found = segmenter.segment(frame(image)).class_ids
        np.testing.assert_array_equal(found, image[..., 0])


def test_as_many_crops_are_used_as_cover_the_image(tmp_path, monkeypatch):
    """More only if they are configured; none where the whole image fits."""
    path = red_channel_model(tmp_path / "a.onnx", [1, 16, 16, 3])
    runs = []
    real = OnnxModel.run
    monkeypatch.setattr(OnnxModel, "run", lambda *given: runs.append(1) or real(*given))
    for width, tiles, expected in ((53, None, 4), (53, 3, 4), (53, 6, 6), (20, None, 1)):
        runs.clear()
        OnnxSegmenter(path, CLASSES, tiles=tiles).segment(frame(banded(16, width, [7])))
        assert len(runs) == expected


def test_a_category_wins_where_crops_overlap(tmp_path):
    """The nearest crop predicts background, the other one car: car. Other classes do not win so."""
    class_ids = np.zeros((16, 16), np.uint8)
    class_ids[:8, :4] = 7
    class_ids[8:, :4] = 3
    segmenter = OnnxSegmenter(constant_model(tmp_path / "a.onnx", class_ids), CLASSES, tiles=5)
    found = segmenter.segment(frame(np.zeros((16, 40, 3), np.uint8))).class_ids
    crops = cut_along(40, 16, 5)
    cars, others = np.zeros(40, bool), np.zeros(40, bool)
    for crop in crops:
        cars[crop.left : crop.left + 4] = True
        others[max(crop.left, crop.own_left) : max(crop.left + 4, crop.own_left)] = True
    np.testing.assert_array_equal(found[:8] == 7, np.tile(cars, (8, 1)))
    np.testing.assert_array_equal(found[8:] == 3, np.tile(others, (8, 1)))
    assert cars.sum() > others.sum()


@pytest.mark.parametrize("channels_last", [False, True])
def test_scores_of_classes_in_either_order(tmp_path, channels_last):
    """The class with the highest score wins, wherever the model puts the classes."""
    path = brightest_channel_model(tmp_path / "a.onnx", [1, 3, 20, 60], channels_last=channels_last)
    image = np.zeros((20, 60, 3), np.uint8)
    image[:, :20, 0] = image[:, 20:40, 1] = image[:, 40:, 2] = 200
    found = OnnxSegmenter(path, CLASSES, scaling="unit").segment(frame(image)).class_ids
    np.testing.assert_array_equal(found, np.tile(np.repeat([0, 1, 2], 20), (20, 1)))


@pytest.mark.parametrize(
    ("scaling", "expected"),
    [("none", (150, 130, 120)), ("unit", (150 / 255, 130 / 255, 120 / 255)),
     ("imagenet", (0.4508, 0.2402, 0.2871))],
)  # fmt: skip
def test_float_models_get_the_scaling_they_need(tmp_path, monkeypatch, scaling, expected):
    """The model gets pixels in 0 to 255, in 0 to 1, or normalised as for ImageNet."""
    path = brightest_channel_model(tmp_path / "a.onnx", [1, 3, 4, 6])
    segmenter = OnnxSegmenter(path, CLASSES, scaling=scaling)
    seen = {}
    run = InferenceSession.run

    def spy(session, names, feeds):
        seen.update(feeds)
        return run(session, names, feeds)

    monkeypatch.setattr(InferenceSession, "run", spy)
    segmenter.segment(frame(np.tile(np.array([150, 130, 120], np.uint8), (4, 6, 1))))
    assert seen["image"].dtype == np.float32
    assert seen["image"][0, :, 2, 3] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("shape", "kind", "more"),
    [
        ([1, 8, 3], TensorProto.UINT8, ()),
        ([1, 8, 8, 4], TensorProto.UINT8, ()),
        ([2, 8, 8, 3], TensorProto.UINT8, ()),
        ([1, 8, 8, 3], TensorProto.INT64, ()),
        ([1, 8, 8, 3], TensorProto.UINT8,
         (helper.make_tensor_value_info("second", TensorProto.FLOAT, [1]),)),
    ],
)  # fmt: skip
def test_an_unexpected_input_is_reported_with_the_expected_one(tmp_path, shape, kind, more):
    """Wrong rank, channels, batch, type, or a second input: one line at the start."""
    nodes = [helper.make_node("Cast", ["image"], ["answer"], to=TensorProto.INT64)]
    path = model(tmp_path / "a.onnx", nodes, shape, kind, rank=len(shape), more=more)
    with pytest.raises(ModelError, match="expected one image") as caught:
        OnnxSegmenter(path, CLASSES)
    assert str(caught.value).startswith(f"{path}: takes image")
    assert "\n" not in str(caught.value)


def test_an_output_that_is_not_a_map_is_rejected(tmp_path):
    """A wrong rank at the start, wrong content with the first frame."""
    nodes = [helper.make_node("ReduceMax", ["image", "axes"], ["answer"], keepdims=0)]
    constants = [("axes", np.array([1, 2]))]
    path = model(
        tmp_path / "a.onnx", nodes, [1, 8, 8, 3], TensorProto.UINT8, constants,
        answer=TensorProto.UINT8, rank=2,
    )  # fmt: skip
    with pytest.raises(ModelError, match="expected class ids"):
        OnnxSegmenter(path, CLASSES)
    nodes = [helper.make_node("Gather", ["image", "zero"], ["answer"], axis=1)]
    path = model(
        tmp_path / "b.onnx", nodes, [1, 3, 8, 8], TensorProto.FLOAT, [("zero", np.array(0))],
        answer=TensorProto.FLOAT,
    )  # fmt: skip
    with pytest.raises(ModelError, match=r"returns float32 \[1, 8, 8\]; expected class ids"):
        OnnxSegmenter(path, CLASSES).segment(frame(np.zeros((8, 8, 3), np.uint8)))


def test_scores_that_are_nan_are_rejected(tmp_path):
    """They would be class 0 in every pixel, and no frame would fail."""
    node = helper.make_node("Log", ["image"], ["answer"])
    path = one_step_model(tmp_path / "a.onnx", node, TensorProto.FLOAT)
    with pytest.raises(ModelError, match=r"a\.onnx: returns scores that are NaN"):
        OnnxSegmenter(path, CLASSES).segment(frame(np.zeros((8, 8, 3), np.uint8)))


def test_class_names_are_not_scores(tmp_path):
    """Text cannot be compared with numbers."""
    node = helper.make_node("Cast", ["image"], ["answer"], to=TensorProto.STRING)
    path = one_step_model(tmp_path / "a.onnx", node, TensorProto.STRING)
    with pytest.raises(ModelError, match=r"returns object .*expected class ids"):
        OnnxSegmenter(path, CLASSES).segment(frame(np.zeros((8, 8, 3), np.uint8)))


@pytest.mark.parametrize("shape", [[1, 3, 200_000, 200_000], [1, 3, 0, 8], [1, "h", 1 << 26, 3]])
def test_a_huge_input_is_rejected_before_a_frame_fills_the_memory(tmp_path, shape):
    """Every frame would be resized to what the model declares."""
    path = brightest_channel_model(tmp_path / "a.onnx", shape)
    with pytest.raises(
        ModelError, match=r"a\.onnx: takes image .*expected an image of 1 to 33554432 pixels"
    ):
        OnnxSegmenter(path, CLASSES)


def test_a_model_of_one_column_has_crops_of_one(tmp_path):
    """A crop never has a width of zero."""
    path = red_channel_model(tmp_path / "a.onnx", [1, 32, 1, 3])
    found = OnnxSegmenter(path, CLASSES).segment(frame(banded(8, 16, [7, 15]))).class_ids
    np.testing.assert_array_equal(found, banded(8, 16, [7, 15])[..., 0])


def test_crops_cover_an_image_whose_width_they_do_not_divide(tmp_path):
    """Crops of 2.5 columns are rounded to 2: then more are needed than the squeeze says."""
    path = red_channel_model(tmp_path / "a.onnx", [1, 16, 1, 3])
    found = OnnxSegmenter(path, CLASSES).segment(frame(banded(40, 120, [7, 15]))).class_ids
    np.testing.assert_array_equal(found, banded(40, 120, [7, 15])[..., 0])


def test_a_model_that_would_need_endless_crops_is_rejected(tmp_path):
    """Each column of the image would be enlarged to 24 x 65536 pixels."""
    path = red_channel_model(tmp_path / "a.onnx", [1, 65536, 24, 3])
    with pytest.raises(ModelError, match="an image of 120 x 40 needs 120 crops; use a model with"):
        OnnxSegmenter(path, CLASSES).segment(frame(banded(40, 120, [7, 15])))


def test_ids_beyond_8_bits_are_rejected(tmp_path):
    """Class 300 is not silently another class."""
    path = constant_model(tmp_path / "a.onnx", np.full((8, 8), 300))
    with pytest.raises(ModelError, match="expected class ids"):
        OnnxSegmenter(path, CLASSES).segment(frame(np.zeros((8, 8, 3), np.uint8)))


@pytest.mark.parametrize("content", [b"", b"no model"])
def test_a_file_that_is_not_a_model_is_reported(tmp_path, content):
    """ONNX Runtime's own errors are not shown."""
    path = tmp_path / "a.onnx"
    path.write_bytes(content)
    with pytest.raises(ModelError, match="not a usable ONNX model") as caught:
        OnnxSegmenter(path, CLASSES)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_missing_model_is_reported(tmp_path):
    """The error says what to set."""
    with pytest.raises(ModelError, match=r"a\.onnx: no such ONNX model; set segmenter\.path"):
        OnnxSegmenter(tmp_path / "a.onnx", CLASSES)


def test_a_frame_without_its_image_is_rejected(tmp_path):
    """The segmenter declares that it needs the image."""
    segmenter = OnnxSegmenter(red_channel_model(tmp_path / "a.onnx", [1, 8, 8, 3]), CLASSES)
    assert segmenter.needs_image
    bare = replace(frame(np.zeros((8, 8, 3), np.uint8)), image=None)
    with pytest.raises(ModelError, match="frame 000001 was read without the image"):
        segmenter.segment(bare)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"scaling": "caffe"}, "use one of imagenet, unit, none"), ({"tiles": 0}, "at least 1")],
)
def test_options_out_of_range_are_rejected(tmp_path, options, message):
    """The error lists the accepted values."""
    path = red_channel_model(tmp_path / "a.onnx", [1, 8, 8, 3])
    with pytest.raises(ConfigError, match=message):
        OnnxSegmenter(path, CLASSES, **options)


def test_deeplab_finds_the_cars_of_a_real_frame(kitti_root):
    """Most pixels of each well visible labelled car are cars; the sky and the road are not."""
    from curate.datasets.kitti.dataset import KittiDataset

    dataset = KittiDataset(kitti_root)
    real, truth = dataset.read("000008", image=True), dataset.annotations("000008")
    path = kitti_root / "segmenter" / "deeplabv3_mnv2_pascal_quant.onnx"
    class_ids = OnnxSegmenter(path, class_map("voc")).segment(real).class_ids
    assert class_ids.shape == (375, 1242)
    shares = []
    for rectangle in truth.select(truth.categories == "Car").boxes_2d.astype(int):
        left, top, right, bottom = rectangle
        shares.append((class_ids[top:bottom, left:right] == 7).mean())
    assert len(shares) == 6
    assert np.median(shares) > 0.6
    assert min(shares) > 0.2
    assert (class_ids[:120] == 7).mean() < 0.01


IMAGE = np.zeros((24, 48, 3), np.uint8)


def segment_constant(path, outputs, kind=TensorProto.FLOAT, shape=(1, 3, 24, 48), **options):
    """Return the class ids from a model with constant outputs for an image of 48 x 24 pixels."""
    constant_outputs(path, outputs, inputs={"pixel_values": (kind, shape)})
    return OnnxSegmenter(path, CLASSES, **options).segment(frame(IMAGE)).class_ids


def halves(height, width, classes=19):
    """Return scores [1, classes, height, width]: class 7 on the left, class 15 on the right."""
    scores = np.zeros((1, classes, height, width), np.float32)
    scores[:, 7, :, : width // 2] = scores[:, 15, :, width // 2 :] = 1
    return scores


EXPECTED = np.tile(np.repeat(np.uint8([7, 15]), 24), (24, 1))


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64])
@pytest.mark.parametrize("size", [(24, 48), (6, 12), (3, 6), (25, 49)])
@pytest.mark.parametrize("channels_last", [False, True])
def test_scores_of_any_size_and_precision(tmp_path, kind, size, channels_last):
    """SegFormer's are a quarter of the input's size, others an eighth, or padded."""
    scores = halves(*size).astype(kind)
    scores = scores.transpose(0, 2, 3, 1) if channels_last else scores
    found = segment_constant(tmp_path / "a.onnx", {"logits": scores})
    assert (found == EXPECTED).mean() > 0.97


@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint8])
@pytest.mark.parametrize("shape", [(1, 24, 48), (1, 1, 24, 48), (1, 24, 48, 1)])
def test_class_ids_of_any_integer_type(tmp_path, kind, shape):
    """With or without an axis of one class."""
    found = segment_constant(tmp_path / "a.onnx", {"any": EXPECTED.astype(kind).reshape(shape)})
    np.testing.assert_array_equal(found, EXPECTED)


@pytest.mark.parametrize(
    ("kind", "shape"),
    [(TensorProto.FLOAT16, (1, 3, 24, 48)), (TensorProto.DOUBLE, (1, 24, 48, 3)),
     (TensorProto.UINT8, ("batch", 3, "height", "width"))],
)  # fmt: skip
def test_inputs_of_any_precision_name_and_order(tmp_path, kind, shape):
    """The pixels are converted to what the model declares."""
    found = segment_constant(tmp_path / "a.onnx", {"logits": halves(24, 48)}, kind, shape)
    np.testing.assert_array_equal(found, EXPECTED)


def test_the_map_of_several_outputs(tmp_path):
    """The output `out` of torchvision beside `aux`, in any order; others are declared."""
    path, scores = tmp_path / "a.onnx", halves(24, 48)
    outputs = {"aux": np.roll(scores, 1, axis=1), "out": scores}
    np.testing.assert_array_equal(segment_constant(path, outputs), EXPECTED)
    outputs = {"hidden": np.zeros((1, 5), np.float32), "logits": scores}
    np.testing.assert_array_equal(segment_constant(path, outputs), EXPECTED)
    outputs = {"a": np.roll(scores, 1, axis=1), "b": scores}
    words = r"returns a tensor.float.\[1, 19, 24, 48\], b .*; several can be the map; set segmenter"
    with pytest.raises(ModelError, match=words):
        segment_constant(path, outputs)
    np.testing.assert_array_equal(segment_constant(path, outputs, output="b"), EXPECTED)
    with pytest.raises(ModelError, match=r"there is no output c; set segmenter\.options\.output"):
        segment_constant(path, outputs, output="c")


def test_scores_that_can_be_read_in_two_orders_are_rejected_with_both(tmp_path):
    """Both leave a nearly square map."""
    path = tmp_path / "a.onnx"
    shape = (1, 3, 48, 48)
    words = "which can be 24 classes first or 20 classes last; set segmenter.options.channels"
    scores = np.zeros((1, 24, 22, 20), np.float32)
    scores[0, 7] = 1
    with pytest.raises(ModelError, match=words):
        segment_constant(path, {"a": scores}, shape=shape)
    found = segment_constant(path, {"a": scores}, shape=shape, channels="first")
    assert np.unique(found).tolist() == [7]
    with pytest.raises(ConfigError, match="channels 'middle': use first or last"):
        segment_constant(path, {"a": scores}, shape=shape, channels="middle")


def test_scores_out_of_proportion_are_rejected(tmp_path):
    """They cannot be a map of the image."""
    words = r"returns float32 \[1, 19, 5, 50\] for an image of 48 x 24 pixels; expected class ids"
    with pytest.raises(ModelError, match=words):
        segment_constant(tmp_path / "a.onnx", {"a": halves(5, 50)})


@pytest.mark.parametrize("early", [False, True])
def test_a_model_that_ends_the_process_is_rejected(tmp_path, early):
    """While it loads, or when it runs for the first time."""
    write_overflowing_model(tmp_path / "a.onnx", early=early, shape=(1, 3, 24, 48))
    with pytest.raises(ModelError, match=r"onnxruntime ends the process \(SIGFPE\)"):
        OnnxSegmenter(tmp_path / "a.onnx", CLASSES, output="boxes").segment(frame(IMAGE))
