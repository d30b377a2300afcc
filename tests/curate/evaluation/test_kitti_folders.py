"""Folders of label and result files."""

import pytest
from support.kitti_scenes import car, to_objects
from support.lidar_only import write_lidar_only

from curate.datasets.kitti.labels import write_objects
from curate.errors import DataError
from curate.evaluation.difficulties import DistanceDifficulty, PointDifficulty
from curate.evaluation.kitti_folders import SensorFolders, evaluate_folders, read_folders

LINE = "Car 0.00 0 0.50 100 100 180 160 1.5 1.6 4.0 0.0 1.7 20.0 0.3"


@pytest.fixture
def folders(tmp_path):
    """Return labels and results of three frames, the second without objects."""
    labels, results = tmp_path / "label_2", tmp_path / "results"
    for folder, score in ((labels, float("nan")), (results, 0.5)):
        folder.mkdir()
        for frame_id, items in (("000002", [car(score=score)]), ("000001", []), ("000007", [])):
            write_objects(folder / f"{frame_id}.txt", to_objects(items))
    return labels, results


def test_frames_are_read_in_order(folders):
    """Sorted ids, and as many labels as results."""
    frame_ids, labels, results = read_folders(*folders)
    assert frame_ids == ("000001", "000002", "000007")
    assert [len(frame) for frame in labels] == [len(frame) for frame in results] == [0, 1, 0]
    assert results[1].scores.tolist() == [0.5]


def test_folders_are_evaluated(folders):
    """Given as text; the one car is found."""
    labels, results = map(str, folders)
    found = evaluate_folders(labels, results)
    assert found.objects[0].tolist() == [1, 1, 1]
    assert found.ap_r40[0, 3].tolist() == [100.0] * 3
    assert evaluate_folders(labels, results, ["000001"]).objects.sum() == 0


def test_only_the_listed_frames_are_read(folders):
    """Other frames may then lack files."""
    (folders[1] / "000007.txt").unlink()
    assert read_folders(*folders, ["000002"])[0] == ("000002",)


def test_hidden_files_are_not_frames(folders):
    """MacOS leaves files beginning with ._ beside the files that it copies."""
    (folders[0] / "._000002.txt").write_bytes(b"\x00\x05\x16\x07")
    assert read_folders(*folders)[0] == ("000001", "000002", "000007")


def test_a_missing_result_file_is_an_error(folders):
    """It contains the first file and what to do; an incomplete run is not evaluated."""
    (folders[1] / "000002.txt").unlink()
    (folders[1] / "000007.txt").unlink()
    with pytest.raises(DataError, match=r"results/000002\.txt.*and 1 other frames.*empty file"):
        read_folders(*folders)


def test_results_without_labels_are_an_error(folders):
    """Also if the frame was requested."""
    write_objects(folders[1] / "000009.txt", to_objects([car()]))
    with pytest.raises(DataError, match=r"label_2/000009\.txt: no label file"):
        read_folders(*folders)
    with pytest.raises(DataError, match=r"label_2/000009\.txt: no label file"):
        read_folders(*folders, ["000009"])


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (LINE, "15 fields"),
        (f"{LINE} 0.5 1", "17 fields"),
        (f"{LINE} nan", "nan"),
        (f"{LINE.replace('1.5 1.6', '-1.5 1.6')} 0.5", "must be positive"),
    ],
)
def test_invalid_result_lines_are_reported(folders, line, message):
    """File, line and reason."""
    path = folders[1] / "000002.txt"
    path.write_text(f"{LINE} 0.5\n{line}\n")
    with pytest.raises(DataError, match=rf"000002\.txt:2: .*{message}"):
        read_folders(*folders)


def test_a_file_of_results_is_not_a_folder(folders, tmp_path):
    """OpenPCDet's result.pkl is evaluated in a workspace."""
    path = tmp_path / "result.pkl"
    path.write_bytes(b"")
    with pytest.raises(DataError, match=r"a file, expected a folder .* --detector-path .*pkl$"):
        evaluate_folders(folders[0], path)


def test_folders_without_text_files_are_rejected(folders, tmp_path):
    """A wrong path and an empty folder give different errors."""
    with pytest.raises(DataError, match="no such folder"):
        read_folders(tmp_path / "absent", folders[1])
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"no \.txt files"):
        read_folders(folders[0], tmp_path / "empty")


def test_missing_2d_boxes_are_projected_with_the_folders_of_sensors(tmp_path):
    """Those beside the labels by default; a given image size replaces the images."""
    made = write_lidar_only(tmp_path)
    assert evaluate_folders(made.labels, made.results).objects[1].tolist() == [6, 6, 6]
    for path in (made.root / "training" / "image_2").iterdir():
        path.unlink()
    assert evaluate_folders(made.labels, made.results).objects.sum() == 0
    sized = SensorFolders(image_size=(1200, 400))
    found = evaluate_folders(made.labels, made.results, sensors=sized)
    assert found.objects[1].tolist() == [6, 6, 6]


def test_levels_and_categories_of_folders(tmp_path):
    """The points in each object are counted; a category that KITTI does not know needs its name."""
    made = write_lidar_only(tmp_path)
    by_points = evaluate_folders(made.labels, made.results, difficulty=PointDifficulty((8, 4, 3)))
    assert by_points.objects.tolist() == [[6, 6, 6], [0, 0, 6], [0, 0, 0]]
    for folder in (made.labels, made.results):
        for path in folder.iterdir():
            path.write_text(path.read_text().replace("Car", "Bus"))
    with pytest.raises(DataError, match="unknown category 'Bus'"):
        evaluate_folders(made.labels, made.results)
    found = evaluate_folders(
        *(made.labels, made.results),
        min_overlaps={"Bus": 0.7},
        difficulty=DistanceDifficulty(()),
    )
    assert found.objects.tolist() == [[6]]
    assert found.ap_r40[0, 3].tolist() == [100]
