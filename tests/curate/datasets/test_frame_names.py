"""Frames under the names that other programs give them."""

import re
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from curate.datasets.frame_names import (
    FrameNames,
    files_by_frame,
    match_frame_list,
)
from curate.errors import ConfigError, DataError

KITTI = tuple(f"{number:06d}" for number in range(12))
DRIVES = ("2011_09_26_drive_0001_sync", "2011_09_26_drive_0002_sync")
RAW = (*(f"{DRIVES[0]}_{n:010d}" for n in range(3)), f"{DRIVES[1]}_0000000007")
ids = st.lists(st.text("0127ab_", min_size=1, max_size=5), min_size=1, max_size=8, unique=True)
names = st.lists(st.text("0127ab_/", min_size=1, max_size=6), min_size=1, max_size=8, unique=True)


def match_frames(names, frame_ids, place="frames"):
    """Return the frame of each name; a name that no frame has is an error."""
    frames = FrameNames.of(frame_ids)
    found, unmatched = frames.match(names, place)
    for name in unmatched:
        frames.require(name, place)
    return found


@pytest.mark.parametrize(
    ("name", "frame"),
    [
        ("000008", "000008"),
        ("8", "000008"),
        ("08", "000008"),
        ("0000000008", "000008"),
        ("0", "000000"),
        ("000008.bin", "000008"),
        ("8.PNG", "000008"),
        ("000008.pcd.bin", "000008"),
        ("training/velodyne/000008.bin", "000008"),
        ("./velodyne/8.bin", "000008"),
        ("C:\\kitti\\training\\velodyne\\000008.bin", "000008"),
        ("/data/2011/000008", "000008"),
    ],
)
def test_every_spelling_of_a_kitti_frame_is_found(name: str, frame: str) -> None:
    assert match_frames([name], KITTI) == {name: frame}


@pytest.mark.parametrize(
    ("name", "frame"),
    [
        (RAW[1], RAW[1]),
        (f"{DRIVES[0]}/0000000001", RAW[1]),
        (f"{DRIVES[0]}/1.png", RAW[1]),
        (f"2011_09_26/{DRIVES[0]}/velodyne_points/data/0000000001.bin", RAW[1]),
        (f"{DRIVES[0]}\\image_02\\data\\0000000001.png", RAW[1]),
        ("0000000001", RAW[1]),
        ("7", RAW[3]),
    ],
)
def test_every_spelling_of_a_drives_frame_is_found(name: str, frame: str) -> None:
    """A number alone is enough if it is unique over the drives."""
    assert FrameNames(RAW).find(name) == frame


def test_a_path_of_another_drive_is_not_matched_by_its_number() -> None:
    """Otherwise the results of a drive would be given to another one."""
    name = "2011_09_26_drive_0009_sync/velodyne_points/data/0000000007.bin"
    with pytest.raises(DataError, match=r"no frame '2011_09_26_drive_0009.*the nearest are '2011"):
        match_frames([name], RAW)


def test_the_digits_of_a_token_are_not_a_number() -> None:
    """Tokens of nuScenes end with digits by chance."""
    assert FrameNames(["e93e98b63d3b40209056d129dc53cee7", "frame_7"]).find("7") == "frame_7"


def test_an_ambiguous_name_is_rejected_with_both_frames() -> None:
    frames = ("a_0001", "b_0001", "1", "001")
    assert match_frames(["1"], frames) == {"1": "1"}
    with pytest.raises(DataError, match=r"list\.txt: '01' could be '001' or '1'; write the whole"):
        match_frames(["01"], frames, "list.txt")
    with pytest.raises(DataError, match="'1' could be 'a_0001' or 'b_0001'"):
        match_frames(["1"], frames[:2])


def test_two_names_of_one_frame_are_rejected() -> None:
    with pytest.raises(DataError, match=r"r\.pkl: '1' and '000001' are both frame 000001; remove"):
        match_frames(["1", "000001"], KITTI, "r.pkl")


def test_an_unknown_name_is_rejected_with_the_nearest() -> None:
    with pytest.raises(DataError, match=r"no frame '000021'; the nearest are '0000.1' and '0000"):
        match_frames(["000021"], KITTI)
    with pytest.raises(DataError, match=r"the nearest is 'a'$"):
        match_frames(["b"], ["a"])


def assert_matched(asked: list[str], frames: list[str], found: dict[str, str]) -> None:
    """Check that every name has another frame, and exact names their own."""
    assert list(found) == asked
    assert len(set(found.values())) == len(found)
    assert set(found.values()) <= set(frames)
    assert all(found[name] == name for name in asked if name in frames)


@given(names, ids)
def test_matching_is_injective_and_exact_names_win(asked: list[str], frames: list[str]) -> None:
    """For every set of names and frames: a frame per name and a name per frame, or an error."""
    try:
        found = match_frames(asked, frames)
    except DataError as error:
        message = str(error)
    else:
        assert_matched(asked, frames, found)
        return
    assert re.search("could be|are both|there is no frame", message)
    assert "\n" not in message


@given(ids)
def test_every_frame_is_found_by_its_id(frames: list[str]) -> None:
    assert match_frames(frames, frames) == {frame: frame for frame in frames}


@given(ids, st.integers(0, 99))
def test_a_number_that_several_frames_have_is_never_matched(frames: list[str], n: int) -> None:
    """Frames with the same number after a separator, none of them named by the number alone."""
    frames = [f"{frame}-{n}" for frame in frames]
    found = FrameNames(frames)
    if len(frames) == 1:
        assert found.find(str(n)) == frames[0]
    else:
        with pytest.raises(DataError, match="could be"):
            found.find(str(n))


def test_many_frames_are_matched_in_linear_time() -> None:
    frames = [f"{number:08d}" for number in range(100_000)]
    start = time.perf_counter()
    assert len(match_frames(map(str, range(100_000)), frames)) == 100_000
    with pytest.raises(DataError, match=r"the nearest are '0009[0-9]*' and"):
        match_frames(["00099999x"], frames)
    assert time.perf_counter() - start < 20


def test_a_list_of_frames_is_matched(tmp_path: Path) -> None:
    """Empty lines, comments, several names in a line, repetitions, names with spaces."""
    path = tmp_path / "list.txt"
    path.write_text("# of the test\n\n000001\n 2.bin \nvelodyne/3.bin 000001\na b\ndrive\n")
    frames = (*KITTI, "a b")
    found = match_frame_list(path, frames, groups={"drive": KITTI[6:8]})
    assert found == ("000001", "000002", "000003", "a b", "000006", "000007")
    path.write_text("000001\n000099\n")
    with pytest.raises(ConfigError, match=r"list\.txt:2: there is no frame '000099'; the nearest"):
        match_frame_list(path, KITTI, error_type=ConfigError)
    assert match_frame_list(path, KITTI, allow_missing=True) == ("000001", "000099")


def test_files_are_matched_by_name(tmp_path: Path) -> None:
    """In the folder, or in subfolders if it has none."""
    for name in (f"{DRIVES[0]}/0000000000.png", f"{DRIVES[1]}/7.png", f"{DRIVES[1]}/99.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = files_by_frame(tmp_path, "*.png", RAW)
    assert {frame: path.name for frame, path in found.items()} == {
        RAW[0]: "0000000000.png",
        RAW[3]: "7.png",
    }
    (tmp_path / "other.png").touch()
    with pytest.raises(DataError, match=r"no file is of a frame .* such as 'other\.png'; the near"):
        files_by_frame(tmp_path, "*.png", RAW)
    (tmp_path / "000001.png").touch()
    (tmp_path / "1.png").touch()
    with pytest.raises(DataError, match=r"'(000001|1)\.png' and '(000001|1)\.png' are both frame"):
        files_by_frame(tmp_path, "*.png", KITTI)
