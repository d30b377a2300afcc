"""The folder of stored maps: damage, other models, limits, several writers."""

import gzip
import json
import logging
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from support.toys import ToyImageSegmenter

from curate.datasets.kitti.dataset import KittiDataset
from curate.errors import DataError
from curate.segmenters.base import SemanticMap
from curate.segmenters.map_store import MapStore, StoringSegmenter, shown_size
from curate.warnings_once import warn_once

CLASSES = {"Car": (7,), "Cyclist": (2, 15)}
IMAGE = "3e" * 32


@pytest.fixture(autouse=True)
def _each_warning_again() -> None:
    warn_once.cache_clear()


def a_map(height: int = 6, width: int = 9) -> SemanticMap:
    """Return a map with several classes."""
    ids = np.random.default_rng(0).integers(0, 256, (height, width), dtype=np.uint8)
    return SemanticMap(ids, CLASSES)


def store_at(root: Path, **changes) -> MapStore:
    """Return a store of the maps of one model."""
    return MapStore(root, **{"made_by": {"model": "a"}, **changes})


@given(class_ids=arrays(np.uint8, st.tuples(st.integers(1, 40), st.integers(1, 40))))
def test_a_map_is_read_as_it_was_written(tmp_path_factory, class_ids: np.ndarray) -> None:
    """Pixels and classes."""
    store = store_at(tmp_path_factory.mktemp("maps"))
    store.write(IMAGE, SemanticMap(class_ids, CLASSES))
    found = store.read(IMAGE, class_ids.shape[::-1])
    np.testing.assert_array_equal(found.class_ids, class_ids)
    assert found.class_ids.dtype == np.uint8
    assert found.category_classes == CLASSES


def test_no_damaged_byte_changes_a_map(tmp_path: Path) -> None:
    """Each byte flipped in turn, and each length: the map as it was, or none."""
    store, made = store_at(tmp_path), a_map()
    store.write(IMAGE, made)
    path = store.path(IMAGE)
    content = path.read_bytes()
    damaged = [
        bytes([*content[:i], content[i] ^ 0x41, *content[i + 1 :]]) for i in range(len(content))
    ]
    damaged += [content[:i] for i in range(len(content))]
    damaged += [content + b"more", b"", gzip.compress(b"no header"), gzip.compress(b"[]\n")]
    unusable = 0
    for each in damaged:
        path.write_bytes(each)
        found = store.read(IMAGE, (9, 6))
        unusable += found is None
        if found is not None:  # a byte of gzip's header without a meaning, such as its time
            np.testing.assert_array_equal(found.class_ids, made.class_ids)
            assert found.category_classes == CLASSES
    assert unusable > 0.9 * len(damaged)


def test_a_small_file_does_not_expand_without_limit(tmp_path: Path) -> None:
    """A few bytes that stand for 100 MB are a damaged map."""
    store = store_at(tmp_path)
    header = {
        "segmenter": store.folder.name,
        "image": IMAGE,
        "height": 6,
        "width": 9,
        "classes": {},
    }
    store.path(IMAGE).parent.mkdir(parents=True)
    content = json.dumps(header).encode() + b"\n" + bytes(100_000_000)
    store.path(IMAGE).write_bytes(gzip.compress(content))
    assert store.read(IMAGE, (9, 6)) is None


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"model": "b"}, "is the map of another segmenter or image"),
        ({}, "has 9 x 6 pixels, the image 9 x 7"),
    ],
)
def test_a_map_of_another_model_or_size_is_not_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, changes: dict, expected: str
) -> None:
    """Even if its file has the name of the right one."""
    one = store_at(tmp_path)
    one.write(IMAGE, a_map())
    other = store_at(tmp_path, made_by={"model": "a"} | changes)
    assert (other.read(IMAGE, (9, 6)) is None) == bool(changes)
    other.path(IMAGE).parent.mkdir(parents=True, exist_ok=True)
    other.path(IMAGE).write_bytes(one.path(IMAGE).read_bytes())
    with caplog.at_level(logging.WARNING):
        assert other.read(IMAGE, (9, 6) if changes else (9, 7)) is None
    assert expected in caplog.text
    assert "is made again" in caplog.text


def test_the_folder_says_what_made_its_maps(tmp_path: Path) -> None:
    """In a file of JSON."""
    store = store_at(tmp_path, made_by={"model": "a", "classes": {"Car": (7,)}})
    store.write(IMAGE, a_map())
    described = json.loads((store.folder / "segmenter.json").read_text())
    assert described == {"model": "a", "classes": {"Car": [7]}}


def test_a_full_folder_takes_no_further_map(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The limit counts the maps of all segmenters, also those that another process writes."""
    other = store_at(tmp_path, made_by={"model": "b"})
    store = store_at(tmp_path, limit_gib=1e-6)
    assert store.refusal() == ""
    while not store.refusal():
        other.write(f"{len(list(tmp_path.rglob('*.gz'))):064x}", a_map(20, 20))
    store.write(IMAGE, a_map())
    assert store.read(IMAGE, (9, 6)) is None
    assert store.unstored == 1
    assert "take 1.049 KiB, the limit segmenter.cache_limit: raise it in curate.toml" in caplog.text
    roomy = store_at(tmp_path)
    roomy.write(IMAGE, a_map())
    assert roomy.read(IMAGE, (9, 6)) is not None


@pytest.mark.parametrize(
    ("size", "shown"),
    [
        (700, "700 bytes"), (1 << 10, "1 KiB"), (1.5 * (1 << 20), "1.5 MiB"), (20 << 30, "20 GiB"),
        (1e-5 * (1 << 30), "10.49 KiB"), (1 << 40, "1024 GiB"),
    ],
)  # fmt: skip
def test_a_size_is_shown_in_a_unit_that_fits(size: float, shown: str) -> None:
    assert shown_size(size) == shown


def test_a_map_that_cannot_be_stored_is_reported_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A file lies where the folder should be."""
    (tmp_path / "maps").write_text("")
    store = store_at(tmp_path / "maps")
    for _ in range(2):
        store.write(IMAGE, a_map())
    assert caplog.text.count("maps that are not there are made again") == 1


def _write_often(root: Path) -> None:
    store = store_at(root)
    for _ in range(100):
        store.write(IMAGE, a_map(200, 300))


def test_processes_may_write_the_same_map_at_once(tmp_path: Path) -> None:
    """A reader always finds a whole one, and no other file is left."""
    context = get_context("fork")
    writers = [context.Process(target=_write_often, args=(tmp_path,)) for _ in range(3)]
    for writer in writers:
        writer.start()
    store, expected = store_at(tmp_path), a_map(200, 300).class_ids
    seen = 0
    while any(writer.is_alive() for writer in writers):
        if store.path(IMAGE).exists():
            np.testing.assert_array_equal(store.read(IMAGE, (300, 200)).class_ids, expected)
            seen += 1
    for writer in writers:
        writer.join()
        assert writer.exitcode == 0
    assert seen
    files = sorted(path.name for path in tmp_path.rglob("*") if path.is_file())
    assert files == [f"{IMAGE}.gz", "segmenter.json"]


@pytest.fixture
def toy(toy_kitti: Path, tmp_path: Path) -> StoringSegmenter:
    """Return a segmenter of toy frames that stores its maps."""
    segmenter = ToyImageSegmenter(tmp_path / "model")
    return StoringSegmenter(segmenter, store_at(tmp_path / "maps"), KittiDataset(toy_kitti))


def test_a_map_is_made_once(toy: StoringSegmenter, toy_kitti: Path, monkeypatch) -> None:
    """Then neither the segmenter nor the decoder of images runs; another image gets another map."""
    dataset = KittiDataset(toy_kitti)
    one, other = (dataset.read(name, points=False) for name in ("000000", "000001"))
    made = toy.segment(one)
    monkeypatch.setattr(KittiDataset, "read", None)
    found = toy.segment(one)
    np.testing.assert_array_equal(found.class_ids, made.class_ids)
    assert found.category_classes == made.category_classes
    monkeypatch.undo()
    image = dataset.read("000000", image=True).image
    np.testing.assert_array_equal(made.class_ids == 1, image[..., 0] >= 128)
    assert (toy.segment(other).class_ids != made.class_ids).any()
    assert toy.segmenter.seen.read_text().split() == ["000000", "000001"]


def test_a_changed_image_gets_a_new_map(toy: StoringSegmenter, toy_kitti: Path) -> None:
    """The name depends on the content of the image, not on its name and time."""
    frame = KittiDataset(toy_kitti).read("000000", points=False)
    before = toy.segment(frame).class_ids
    folder = toy_kitti / "training" / "image_2"
    (folder / "000000.png").write_bytes((folder / "000001.png").read_bytes())
    after = toy.segment(frame).class_ids
    assert (after != before).any()
    np.testing.assert_array_equal(after, toy.segment(replace(frame, frame_id="000001")).class_ids)


def test_a_map_of_a_wrong_size_is_returned_but_not_stored(
    toy: StoringSegmenter, toy_kitti: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The semantic prior then says what is wrong, whenever it asks."""
    small = SemanticMap(np.zeros((2, 2), np.uint8), {})
    monkeypatch.setattr(toy.segmenter, "segment", lambda _frame: small)
    frame = KittiDataset(toy_kitti).read("000000", points=False)
    assert toy.segment(frame) is small
    assert not toy.store.root.exists()
    assert toy.store.unstored == 1


def test_a_missing_image_is_an_error(toy: StoringSegmenter, toy_kitti: Path) -> None:
    """Of the frame alone, with its path."""
    frame = KittiDataset(toy_kitti).read("000000", points=False)
    (toy_kitti / "training" / "image_2" / "000000.png").unlink()
    with pytest.raises(DataError, match=r"000000\.png"):
        toy.segment(frame)
