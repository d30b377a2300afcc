"""Saved semantic maps."""

import struct
import zlib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from support.toys import toy_calibration

from curate.errors import ConfigError, DataError, ModelError
from curate.frames import Frame
from curate.segmenters.classes import class_map
from curate.segmenters.saved import SavedSegmenter

FRAME = Frame("000001", np.zeros((0, 4), np.float32), toy_calibration(), (12, 5))
CLASSES = {"Car": (7,)}


def save(directory, class_ids):
    """Save a map of the frame."""
    cv2.imwrite(str(directory / "000001.png"), class_ids)


def test_it_reads_the_map_of_a_frame(tmp_path):
    """The pixels of the PNG are the class ids; the image is not needed."""
    class_ids = np.random.default_rng(0).integers(0, 255, (5, 12), dtype=np.uint8)
    save(tmp_path, class_ids)
    segmenter = SavedSegmenter(tmp_path, CLASSES)
    found = segmenter.segment(FRAME)
    np.testing.assert_array_equal(found.class_ids, class_ids)
    assert found.category_classes == CLASSES
    assert not segmenter.needs_image


@pytest.mark.parametrize(
    ("class_ids", "message"),
    [
        (np.zeros((5, 11), np.uint8), "the map is 11 x 5 pixels, the image of the frame is 12 x 5"),
        (
            np.zeros((5, 12, 3), np.uint8),
            "a map in colours; if .*colours to one of camvid, cityscapes.* or to a table, if one",
        ),
        (
            np.zeros((5, 12), np.uint16),
            "16 bits can be class ids, or class . divisor . instance; set segmenter.options.div",
        ),
    ],
)
def test_a_map_that_does_not_fit_is_rejected(tmp_path, class_ids, message):
    """Wrong size, colours or depth: the error contains the file."""
    save(tmp_path, class_ids)
    with pytest.raises(DataError, match=message) as caught:
        SavedSegmenter(tmp_path, CLASSES).segment(FRAME)
    assert "000001.png" in str(caught.value)


def test_instance_ids_are_divided_by_the_divisor(tmp_path):
    """Cityscapes' instanceIds: class * 1000 + instance, classes without instances as they are."""
    values = np.array([26001, 26999, 24000, 7, 255, 33001], np.uint16)
    save(tmp_path, np.tile(values, (5, 2)))
    classes = class_map("cityscapes-label-ids")
    found = SavedSegmenter(tmp_path, classes, divisor=1000).segment(FRAME)
    assert found.class_ids.dtype == np.uint8
    assert found.class_ids[0, :6].tolist() == [26, 26, 24, 7, 255, 33]
    with pytest.raises(DataError, match="class 330 with divisor 100"):
        SavedSegmenter(tmp_path, classes, divisor=100, below="class").segment(FRAME)
    with pytest.raises(ConfigError, match="divisor 0: expected an integer of at least 1"):
        SavedSegmenter(tmp_path, classes, divisor=0)


def read(directory, classes=CLASSES, **options):
    """Return the class ids of the frame's map."""
    return SavedSegmenter(directory, classes, **options).segment(FRAME).class_ids


def row(*values):
    """Return a map with these values at the start of each row, in 16 bits."""
    return np.tile(np.array([*values, *[0] * (12 - len(values))], np.uint16), (5, 1))


def test_instances_of_kitti_are_always_divided(tmp_path):
    """A value below 256 is an instance of class 0 there, not a class."""
    save(tmp_path, row(26 * 256 + 3, 7 * 256, 5, 0))
    assert read(tmp_path, divisor=256)[0, :4].tolist() == [26, 7, 0, 0]
    assert read(tmp_path, divisor=256, below="class")[0, :4].tolist() == [26, 7, 5, 0]


def test_class_ids_in_16_bits_are_declared(tmp_path):
    """Divisor 1: the value is the class."""
    save(tmp_path, row(7, 15, 255))
    assert read(tmp_path, divisor=1)[0, :3].tolist() == [7, 15, 255]


def test_small_values_of_an_unknown_divisor_are_rejected_with_both_readings(tmp_path):
    """Class 7 without an instance, or instance 7 of class 0."""
    save(tmp_path, row(26_010, 7))
    words = "contains 7, which can be class 7 without an instance, or instance 7 of class 0; set "
    with pytest.raises(DataError, match=words):
        read(tmp_path, divisor=500)
    assert read(tmp_path, divisor=500, below="class")[0, :2].tolist() == [52, 7]
    assert read(tmp_path, divisor=500, below="instance")[0, :2].tolist() == [52, 0]


def indexed(directory, values, palette, depth=8, **more):
    """Save a PNG with a palette."""
    image = Image.fromarray(values.astype(np.uint8), "P")
    image.putpalette(np.asarray(palette, np.uint8).reshape(-1).tolist())
    image.save(directory / "000001.png", bits=depth, **more)


@pytest.mark.parametrize("depth", [1, 2, 4, 8])
@pytest.mark.parametrize("optimised", [False, True])
def test_the_indices_of_a_palette_are_the_class_ids(tmp_path, depth, optimised):
    """Whatever its colours, as in Pascal VOC's maps; also with opacity and a background."""
    count = 1 << depth
    values = np.random.default_rng(depth).integers(0, count, (5, 12))
    palette = np.random.default_rng(0).integers(0, 256, (count, 3))
    indexed(tmp_path, values, palette, depth, transparency=0, optimize=optimised)
    raw = (tmp_path / "000001.png").read_bytes()
    assert raw[24:26] == bytes([depth, 3])
    np.testing.assert_array_equal(read(tmp_path), values)


def test_the_map_of_case_14(tmp_path):
    """Car, person and the border of Pascal VOC, with its palette."""
    values = np.zeros((5, 12), np.uint8)
    values[:, 3:8], values[1], values[2, 2:4] = 7, 15, 255
    indexed(tmp_path, values, VOC_PALETTE)
    found = read(tmp_path, class_map("voc"))
    assert np.unique(found).tolist() == [0, 7, 15, 255]
    np.testing.assert_array_equal(found, values)


def voc_palette():
    """Return the palette of Pascal VOC's maps, by the devkit's description."""
    palette = np.zeros((256, 3), np.uint8)
    for index in range(256):
        for bit in range(8):
            palette[index, bit % 3] |= ((index >> bit) & 1) << (7 - bit // 3)
    return palette


VOC_PALETTE = voc_palette()


@pytest.mark.parametrize("depth", [1, 2, 4])
def test_grey_values_of_few_bits_are_not_scaled(tmp_path, depth):
    """OpenCV stretches them to 0..255."""
    values = np.random.default_rng(depth).integers(0, 1 << depth, (5, 12)).astype(np.uint8)
    write_grey_png(tmp_path / "000001.png", values, depth)
    np.testing.assert_array_equal(read(tmp_path), values)


def write_grey_png(path, values, depth):
    """Write a grey PNG of any depth."""
    bits = np.unpackbits(values[:, :, None], axis=2)[:, :, 8 - depth :].reshape(len(values), -1)
    rows = b"".join(b"\0" + line.tobytes() for line in np.packbits(bits, axis=1))
    head = struct.pack(">IIBBBBB", values.shape[1], values.shape[0], depth, 0, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n"
    for kind, part in ((b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")):
        checksum = struct.pack(">I", zlib.crc32(kind + part))
        content += struct.pack(">I", len(part)) + kind + part + checksum
    path.write_bytes(content)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P"])
@pytest.mark.parametrize(
    ("name", "colours", "ids"),
    [
        ("cityscapes", [(0, 0, 142), (220, 20, 60), (0, 0, 0), (81, 0, 81)], [13, 11, 255, 255]),
        ("cityscapes-label-ids", [(0, 0, 142), (220, 20, 60), (0, 0, 0)], [26, 24, 0]),
        ("voc", [(128, 128, 128), (192, 128, 128), (224, 224, 192)], [7, 15, 255]),
        ("camvid", [(64, 0, 128), (64, 64, 0), (0, 128, 192)], [8, 9, 10]),
    ],
)
def test_classes_in_colours(tmp_path, name, colours, ids, mode):
    """By a declared table, in any kind of PNG."""
    pixels = np.tile(np.array([colours[i % len(colours)] for i in range(12)], np.uint8), (5, 1, 1))
    image = Image.fromarray(pixels, "RGB")
    image = image.quantize(16) if mode == "P" else image.convert(mode)
    image.save(tmp_path / "000001.png")
    found = read(tmp_path, class_map(name), colours=name)
    assert found[0].tolist() == [ids[i % len(ids)] for i in range(12)]


def test_a_table_of_colours_of_your_own(tmp_path):
    """Class 1 is red; any other colour is rejected with its place."""
    pixels = np.zeros((5, 12, 3), np.uint8)
    pixels[2, 3] = (255, 0, 0)
    Image.fromarray(pixels).save(tmp_path / "000001.png")
    table = {"0": [0, 0, 0], "1": [255, 0, 0]}
    assert read(tmp_path, colours=table)[2, 3] == 1
    with pytest.raises(DataError, match=r"colour \[255, 0, 0\] in row 2, column 3 is not in"):
        read(tmp_path, colours={"0": [0, 0, 0]})


def test_the_class_in_one_channel(tmp_path):
    """As CARLA saves it."""
    pixels = np.zeros((5, 12, 4), np.uint8)
    pixels[:, 4, 0], pixels[..., 3] = 10, 255
    Image.fromarray(pixels).save(tmp_path / "000001.png")
    assert read(tmp_path, channel="red")[0, 3:6].tolist() == [0, 10, 0]


def test_a_palette_in_another_order_than_the_class_set_is_rejected(tmp_path):
    """A map in VOC's colours that was saved with a palette of its own."""
    values = np.zeros((5, 12), np.uint8)
    values[0, 0] = 1
    indexed(tmp_path, values, VOC_PALETTE[[0, 7]])
    words = "index 1 of the palette can be class 1, or class 7 of voc by its colour"
    with pytest.raises(DataError, match=words):
        read(tmp_path, class_map("voc"))
    assert read(tmp_path, class_map("voc"), colours="voc")[0, 0] == 7
    assert read(tmp_path, class_map("voc"), colours="none")[0, 0] == 1


@pytest.mark.parametrize("kind", [np.uint8, np.int64, np.bool_])
def test_an_array_of_class_ids(tmp_path, kind):
    """As np.save writes an argmax."""
    values = np.arange(60).reshape(5, 12).astype(kind)
    np.save(tmp_path / "000001.npy", values)
    np.testing.assert_array_equal(read(tmp_path), values)
    save(tmp_path, np.zeros((5, 12), np.uint8))
    with pytest.raises(DataError, match=r"000001.npy is a map of the same frame; remove one"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((5, 12), np.float32), "expected integers"),
        (np.zeros((5, 12, 3), np.uint8), "expected integers"),
        (np.full((5, 12), -1), "contains -1, a class id is at least 0"),
        (np.full((5, 12), 300), "class 300 with divisor 1, expected 0 to 255"),
        (np.array([[object()]]), "not a readable .npy array"),
    ],
)
def test_an_array_that_is_not_a_map_is_rejected(tmp_path, values, message):
    """With its type and shape."""
    np.save(tmp_path / "000001.npy", values, allow_pickle=True)
    with pytest.raises(DataError, match=message):
        read(tmp_path)


@pytest.mark.parametrize("name", ["000001.jpg", "000001.png"])
def test_a_jpeg_is_rejected(tmp_path, name):
    """Its values are not those that were saved, whatever its name."""
    _, content = cv2.imencode(".jpg", np.zeros((5, 12), np.uint8))
    (tmp_path / name).write_bytes(content.tobytes())
    with pytest.raises(DataError, match="a JPEG changes the values of a map"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"below": "both"}, "below 'both': use class or instance"),
        ({"channel": "alpha"}, "channel 'alpha': use one of red, green, blue"),
        ({"colours": "citiscapes"}, "use camvid, cityscapes, .* or a table; did you mean"),
        ({"colours": {"1": [1, 2]}}, "is not a colour like"),
        ({"colours": {"1": [0, 0, 256]}}, "is not a colour like"),
        ({"colours": {"car": [0, 0, 0]}}, "'car' is not a class id from 0 to 255"),
        ({"colours": {"1": [1, 1, 1], "2": [1, 1, 1]}}, "two classes have the colour"),
        ({"colours": "voc", "divisor": 256}, "declare only one of divisor, colours and channel"),
    ],
)
def test_invalid_options_are_rejected(tmp_path, options, message):
    """When the segmenter is opened."""
    with pytest.raises(ConfigError, match=message):
        SavedSegmenter(tmp_path, CLASSES, **options)


@pytest.mark.parametrize(
    ("declared", "present", "message"),
    [
        (
            "cityscapes",
            26,
            "class 26, .* cityscapes are 0 to 18; .* uses cityscapes-label-ids",
        ),
        ("voc", 33, "class 33, .* voc are 0 to 20; .* uses cityscapes-label-ids"),
        (
            "simulated",
            13,
            "class 13, .* simulated are 0 to 3; .* uses voc or cityscapes or",
        ),
        ("cityscapes-label-ids", 90, "class 90, .* cityscapes-label-ids are 0 to 33$"),
    ],
)
def test_maps_of_another_class_set_are_rejected(tmp_path, declared, present, message):
    """Cityscapes' label ids read as train ids would make every car a bus or nothing."""
    class_ids = np.zeros((5, 12), np.uint8)
    class_ids[0, :2] = present, 255
    save(tmp_path, class_ids)
    with pytest.raises(DataError, match=message):
        SavedSegmenter(tmp_path, class_map(declared)).segment(FRAME)
    assert SavedSegmenter(tmp_path, class_map("coco")).segment(FRAME).class_ids[0, 0] == present


def test_missing_and_unreadable_maps_are_reported(tmp_path):
    """No map, invalid bytes, and no folder."""
    segmenter = SavedSegmenter(tmp_path, CLASSES)
    with pytest.raises(DataError, match=r"000001\.png: no such image file"):
        segmenter.segment(FRAME)
    (tmp_path / "000001.png").write_bytes(b"no image")
    with pytest.raises(DataError, match=r"000001\.png: not a readable PNG or JPEG image"):
        segmenter.segment(FRAME)
    with pytest.raises(DataError, match="no such folder of semantic maps"):
        SavedSegmenter(tmp_path / "missing", CLASSES)
    with pytest.raises(ConfigError, match="an id is an integer from 0 to 255"):
        SavedSegmenter(tmp_path, {"Car": (300,)})


@pytest.mark.parametrize("name", ["1.png", "0001.png", "000001.PNG", "sub/000001.png"])
def test_maps_are_matched_with_frames_in_every_spelling(tmp_path, name):
    """A number, other leading zeros, a subfolder."""
    (tmp_path / name).parent.mkdir(exist_ok=True)
    cv2.imwrite(str(tmp_path / name), np.full((5, 12), 7, np.uint8))
    found = SavedSegmenter(tmp_path, CLASSES, frame_ids=("000000", "000001")).segment(FRAME)
    assert (found.class_ids == 7).all()


def test_maps_of_no_frame_are_rejected(tmp_path):
    """When the segmenter is opened, with the nearest frames."""
    save(tmp_path, np.zeros((5, 12), np.uint8))
    message = r"such as '000001\.png'; the nearest are '0000\d\d' and"
    with pytest.raises(DataError, match=message):
        SavedSegmenter(tmp_path, CLASSES, frame_ids=("000010", "000021"))


def test_several_cameras_have_a_folder_each(tmp_path):
    """The map of a camera is not taken for that of another, nor for that of the only one."""
    for i, camera in enumerate(("front", "back"), start=1):
        (tmp_path / camera).mkdir()
        save(tmp_path / camera, np.full((5, 12), i, np.uint8))
    segmenter = SavedSegmenter(tmp_path, CLASSES)
    assert segmenter.segment(replace(FRAME, camera="front")).class_ids.max() == 1
    assert segmenter.segment(replace(FRAME, camera="back")).class_ids.min() == 2
    with pytest.raises(DataError, match=r"000001\.png: no such image"):
        segmenter.segment(FRAME)
    with pytest.raises(ModelError, match="000001 has no camera"):
        segmenter.segment(replace(FRAME, image_size=None, camera="front"))
