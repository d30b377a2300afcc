"""tracklet_labels.xml of KITTI raw, compared with an independent calculation."""

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from support.dataset_layouts import DRIVE, write_toy_raw

from curate.datasets.kitti.raw import KittiRawDataset
from curate.errors import DataError

DAY = "2011_09_26"
CAR = {"objectType": "Car", "h": 1.5, "w": 1.6, "l": 4.0, "first_frame": 0}


def pose(**values: float) -> str:
    """Return a pose at (20, 0, -1.7), with other values where given."""
    fields = {"tx": 20, "ty": 0, "tz": -1.7, "rx": 0, "ry": 0, "rz": 0, "state": 2}
    fields |= {"occlusion": 0, "occlusion_kf": 0, "truncation": 0, "amt_occlusion": -1}
    inner = "".join(f"<{key}>{value}</{key}>\n" for key, value in (fields | values).items())
    return f"<item>\n{inner}</item>\n"


def tracklet(*poses: str, **values: object) -> str:
    """Return a tracklet of a car, with other values where given."""
    inner = "".join(f"<{key}>{value}</{key}>\n" for key, value in (CAR | values).items())
    return (
        f'<item class_id="1" version="1">\n{inner}<poses class_id="2" version="0">\n'
        f"<count>{len(poses)}</count>\n<item_version>2</item_version>\n{''.join(poses)}</poses>\n"
        "<finished>1</finished>\n</item>\n"
    )


def write_tracklets(root: Path, *tracklets: str, head: str = "<!DOCTYPE boost_serialization>"):
    """Write a drive of four frames with these tracklets and without label_2."""
    write_toy_raw(root)
    drive = root / DAY / DRIVE
    for path in (drive / "label_2").iterdir():
        path.unlink()
    (drive / "label_2").rmdir()
    (drive / "tracklet_labels.xml").write_text(
        f'<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n{head}\n'
        '<boost_serialization signature="serialization::archive" version="9">\n'
        '<tracklets class_id="0" tracking_level="0" version="0">\n'
        f"<count>{len(tracklets)}</count>\n"
        f"<item_version>1</item_version>\n{''.join(tracklets)}</tracklets>\n</boost_serialization>\n"
    )
    return KittiRawDataset(root)


def frame(number: int) -> str:
    """Return the id of a frame of the toy drive."""
    return f"{DRIVE}_{number:010d}"


def test_a_pose_is_the_bottom_centre_in_the_lidar_frame(tmp_path: Path) -> None:
    """Length along the heading, rotation about z, the centre half a height above the pose."""
    dataset = write_tracklets(tmp_path, tracklet(pose(tx=15, ty=2, tz=-1.6, rz=0.5 - 2 * math.pi)))
    truth = dataset.annotations(frame(0))
    assert truth.categories.tolist() == ["Car"]
    np.testing.assert_allclose(truth.boxes, [[15, 2, -0.85, 4.0, 1.6, 1.5, 0.5]], atol=1e-12)
    # The toy camera is at the LiDAR and looks along x: u = 60 - 60 y / x, v = 20 - 60 z / x.
    corners = [
        (
            15 + 2 * a * math.cos(0.5) - 0.8 * b * math.sin(0.5),
            2 + 2 * a * math.sin(0.5) + 0.8 * b * math.cos(0.5),
            z,
        )
        for a in (-1, 1)
        for b in (-1, 1)
        for z in (-1.6, -0.1)
    ]
    columns = [60 - 60 * y / x for x, y, _ in corners]
    rows = [20 - 60 * z / x for x, _, z in corners]
    expected = [min(columns), min(rows), max(columns), max(rows)]
    np.testing.assert_allclose(truth.boxes_2d, [expected], atol=1e-9)
    # rotation_y is the angle of the heading in the camera's x-z plane, clockwise from x.
    rotation_y = math.atan2(-math.cos(0.5), -math.sin(0.5))
    np.testing.assert_allclose(truth.alpha, [rotation_y - math.atan2(-2, 15)], atol=1e-12)


def test_poses_begin_at_the_first_frame(tmp_path: Path) -> None:
    """Frames before and after the poses have no object of the tracklet."""
    late = tracklet(pose(tx=10), pose(tx=11), first_frame=1)
    whole = tracklet(*(pose(tx=20 + k) for k in range(4)), objectType="Person (sitting)")
    dataset = write_tracklets(tmp_path, late, whole)
    found = [dataset.annotations(frame(k)) for k in range(4)]
    assert [truth.boxes[:, 0].tolist() for truth in found] == [[20], [10, 21], [11, 22], [23]]
    assert found[0].categories.tolist() == ["Person_sitting"]
    assert dataset.files(frame(0)).label.name == "tracklet_labels.xml"


def test_states_become_kittis_levels(tmp_path: Path) -> None:
    """Objects outside of the image or behind the camera are left out."""
    dataset = write_tracklets(
        tmp_path,
        tracklet(pose(tx=10, occlusion=1, truncation=99)),
        tracklet(pose(tx=11, occlusion=2, truncation=-1)),
        tracklet(pose(tx=12, occlusion=-1, truncation=1)),
        tracklet(pose(tx=13, truncation=2)),
        tracklet(pose(tx=14, truncation=3)),
        tracklet(pose(tx=-15)),
        tracklet(pose(tx=6, ty=6)),
    )
    truth = dataset.annotations(frame(0))
    assert truth.boxes[:, 0].tolist() == [10, 11, 12, 6]
    assert truth.occluded.tolist() == [1, 2, 3, 0]
    assert truth.truncated[:3].tolist() == [0, 0, 0]
    assert 0.2 < truth.truncated[3] < 0.8


def test_without_images_all_objects_are_kept(tmp_path: Path) -> None:
    write_tracklets(tmp_path, tracklet(pose(tx=10)), tracklet(pose(tx=-15, truncation=3)))
    shutil.rmtree(tmp_path / DAY / DRIVE / "image_02")
    truth = KittiRawDataset(tmp_path).annotations(frame(0))
    assert truth.boxes[:, 0].tolist() == [10, -15]


def test_label_files_come_before_tracklets(tmp_path: Path) -> None:
    write_tracklets(tmp_path, tracklet(pose()))
    drive = tmp_path / DAY / DRIVE
    (drive / "label_2").mkdir()
    (drive / "label_2" / "0000000000.txt").write_text(
        "Van 0 0 0 0 0 9 9 1.5 1.6 3.9 1.0 1.7 20.0 -1.57\n"
    )
    dataset = KittiRawDataset(tmp_path)
    assert dataset.annotations(frame(0)).categories.tolist() == ["Van"]
    assert dataset.files(frame(1)).label is None


BOMB = (
    '<!DOCTYPE boost_serialization [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">'
    '<!ENTITY c "&b;&b;&b;&b;">]>'
)
OUTER = '<!DOCTYPE boost_serialization [<!ENTITY a SYSTEM "file:///etc/passwd">]>'


@pytest.mark.parametrize("head", [BOMB, OUTER])
def test_entities_are_rejected(tmp_path: Path, head: str) -> None:
    """Whether they expand or refer to another file."""
    dataset = write_tracklets(tmp_path, tracklet(pose(), objectType="&a;"), head=head)
    with pytest.raises(DataError, match=r"tracklet_labels\.xml:2: declares an entity"):
        dataset.annotations(frame(0))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (tracklet(pose(tx="far")), r"xml:\d+: <tx> is 'far', not a valid number"),
        (tracklet(pose(rz="nan")), r"xml:\d+: <rz> is 'nan', not a valid number"),
        (tracklet(pose(), h=0), r"xml:7: size of 0 x 1.6 x 4 m of a Car"),
        (tracklet(pose(), objectType=""), r"xml:7: <item> must have one <objectType>"),
        (tracklet(pose()).replace("<ty>0</ty>", ""), r"xml:\d+: <item> must have one <ty>"),
        (tracklet(pose(ry=0.5)), r"xml:\d+: rotated about x or y; only rotation about z"),
        ("<item>", "not XML: mismatched tag"),
        ("<a>" * 30 + "</a>" * 30, "too many nested elements"),
    ],
)
def test_invalid_tracklets_are_reported(tmp_path: Path, content: str, message: str) -> None:
    dataset = write_tracklets(tmp_path, content)
    with pytest.raises(DataError, match=message) as caught:
        dataset.annotations(frame(0))
    assert "\n" not in str(caught.value)


def test_other_xml_is_not_taken_for_tracklets(tmp_path: Path) -> None:
    dataset = write_tracklets(tmp_path)
    (tmp_path / DAY / DRIVE / "tracklet_labels.xml").write_text("<annotations/>")
    with pytest.raises(DataError, match="no <boost_serialization> with <tracklets>"):
        dataset.annotations(frame(0))
