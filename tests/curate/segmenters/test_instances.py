"""Instance masks in COCO's JSON as semantic maps, and the semantic prior on them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from oracles import run_lengths
from support.toys import SIZES, toy_calibration

from curate.detections import Detections, as_categories
from curate.errors import ConfigError, DataError
from curate.frames import Frame
from curate.geometry.projection import image_rectangles
from curate.priors.semantic import SemanticPrior
from curate.segmenters.classes import class_map
from curate.segmenters.instances import InstanceSegmenter

COCO = class_map("coco")
FRAME = Frame("000007", np.zeros((0, 4), np.float32), toy_calibration(), (120, 40))


def rectangle(left: int, top: int, right: int, bottom: int) -> list[list[float]]:
    """Return a polygon over whole pixels."""
    return [[left, top, right, top, right, bottom, left, bottom]]


def encoded(class_ids: np.ndarray) -> dict:
    """Return compressed run lengths of a mask of all non-zero pixels."""
    return {
        "size": list(class_ids.shape),
        "counts": run_lengths.compress(run_lengths.runs((class_ids > 0).tolist())),
    }


def save(path: Path, content: object) -> Path:
    """Write JSON."""
    path.write_text(json.dumps(content))
    return path


CAR = {"image_id": 7, "category_id": 3, "segmentation": rectangle(10, 5, 30, 25), "score": 0.9}
PERSON = {"image_id": 7, "category_id": 1, "segmentation": rectangle(25, 0, 40, 40), "score": 0.6}
GHOST = {**CAR, "segmentation": rectangle(0, 0, 120, 40), "score": 0.3}


def expected() -> np.ndarray:
    """Return the map with the car over the person, without the low-score object."""
    class_ids = np.zeros((40, 120), np.uint8)
    class_ids[0:40, 25:40] = 1
    class_ids[5:25, 10:30] = 3
    return class_ids


@pytest.mark.parametrize("form", ["results", "document", "folder"])
def test_every_format_gives_the_same_map(tmp_path: Path, form: str) -> None:
    """A list of results, COCO's document, a file per frame; higher scores are on top."""
    objects = [CAR, GHOST, PERSON]
    if form == "results":
        path = save(tmp_path / "a.json", objects)
    elif form == "document":
        images = [{"id": 7, "file_name": "image_2/000007.png"}]
        path = save(tmp_path / "a.json", {"images": images, "annotations": objects})
    else:
        path = save(tmp_path / "000007.json", objects).parent
    segmenter = InstanceSegmenter(path, COCO)
    found = segmenter.segment(FRAME)
    np.testing.assert_array_equal(found.class_ids, expected())
    assert found.category_classes == COCO
    assert not segmenter.needs_image


def test_run_lengths_and_polygons_are_the_same_object(tmp_path: Path) -> None:
    """Compressed, as detectors write them."""
    mask = expected() == 3
    coded = {**CAR, "segmentation": encoded(mask.astype(np.uint8))}
    found = InstanceSegmenter(save(tmp_path / "a.json", [coded]), COCO).segment(FRAME)
    np.testing.assert_array_equal(found.class_ids == 3, mask)


def test_an_object_of_another_class_hides_what_is_behind_it(tmp_path: Path) -> None:
    """A bus in front of a car; its number belongs to no category."""
    bus = {**CAR, "category_id": 6, "segmentation": rectangle(20, 0, 40, 40), "score": 0.95}
    found = InstanceSegmenter(save(tmp_path / "a.json", [bus, CAR]), COCO).segment(FRAME)
    assert (found.class_ids[:, 20:40] == 0).all()
    assert (found.class_ids[5:25, 10:20] == 3).all()


def test_the_semantic_prior_counts_the_pixels_of_masks(tmp_path: Path) -> None:
    """A mask over the left half of a car's rectangle: S / A is the share of its columns."""
    boxes = np.array([[10.0, 0, -0.8, *SIZES["Car"], 0.0]])
    rectangles = image_rectangles(boxes, FRAME.calibration, FRAME.image_size)
    left, _, right, _ = rectangles[0]
    middle = round((left + right) / 2)
    half = {**CAR, "segmentation": rectangle(0, 0, middle, 40)}
    prior = SemanticPrior(InstanceSegmenter(save(tmp_path / "a.json", [half]), COCO))
    cars = Detections(boxes, np.array([0.81]), as_categories(["Car"]))
    evidence = prior.score(FRAME, cars)
    columns = np.arange(np.floor(left + 0.5), np.floor(right + 0.5) + 1)
    share = (columns < middle).mean()
    assert evidence["rho_anno"] == pytest.approx(np.sqrt(0.81 * share))
    assert 0.4 < share < 0.6


def test_a_frame_without_objects_is_not_a_frame_without_masks(tmp_path: Path) -> None:
    """Listed among the images: an empty map. Not listed: an error that says what to do."""
    document = {"images": [{"id": 1, "file_name": "000007.png"}], "annotations": []}
    found = InstanceSegmenter(save(tmp_path / "a.json", document), COCO).segment(FRAME)
    assert not found.class_ids.any()
    with pytest.raises(DataError, match=r"no masks for frame 000007; .*images"):
        InstanceSegmenter(save(tmp_path / "b.json", [{**CAR, "image_id": 8}]), COCO).segment(FRAME)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"annotations": 3}, "expected a list of instance masks"),
        ([3], "expected a list of instance masks"),
        ([{"category_id": 3}], "no image_id"),
        ({"images": [{"id": 1}], "annotations": []}, "no file_name"),
        ([{"image_id": 7, "category_id": 3}], "object 0 has no segmentation"),
        ([{**CAR, "score": "high"}], "the score is not a number from 0 to 1"),
        ([CAR, {**CAR, "segmentation": {"size": [20, 60], "counts": [1200]}}],
         "object 1: the mask is 60 x 20 pixels, the image is 120 x 40"),
    ],
)  # fmt: skip
def test_malformed_masks_are_reported(tmp_path: Path, content: object, message: str) -> None:
    """File, object and reason in one line."""
    path = save(tmp_path / "a.json", content)
    with pytest.raises(DataError) as caught:
        InstanceSegmenter(path, COCO).segment(FRAME)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_score_out_of_range_is_rejected(tmp_path: Path) -> None:
    """Before any frame."""
    with pytest.raises(ConfigError, match=r"minimum_score 1\.5"):
        InstanceSegmenter(save(tmp_path / "a.json", []), COCO, minimum_score=1.5)


@pytest.mark.parametrize("name", ["000007.png", "7.jpg", "image_2/000007.png", "image_2\\7.png"])
def test_images_are_matched_with_frames_in_every_spelling(tmp_path: Path, name: str) -> None:
    """COCO's file_name may be a path; two images of one frame are rejected."""
    images = [{"id": 7, "file_name": name}]
    path = save(tmp_path / "a.json", {"images": images, "annotations": [CAR, PERSON]})
    frame_ids = ("000006", "000007")
    found = InstanceSegmenter(path, COCO, frame_ids=frame_ids).segment(FRAME)
    np.testing.assert_array_equal(found.class_ids, expected())
    images.append({"id": 8, "file_name": "07.png"})
    save(path, {"images": images, "annotations": [CAR]})
    with pytest.raises(DataError, match="are both frame 000007; remove one"):
        InstanceSegmenter(path, COCO, frame_ids=frame_ids)
    save(path, {"images": [{"id": 7, "file_name": "b.png"}], "annotations": [CAR]})
    with pytest.raises(DataError, match=r"no image is of a frame .* such as 'b\.png'; the nearest"):
        InstanceSegmenter(path, COCO, frame_ids=frame_ids)


def test_a_folder_of_masks_is_matched_with_frames(tmp_path: Path) -> None:
    """By number as well."""
    save(tmp_path / "7.json", [CAR, PERSON])
    found = InstanceSegmenter(tmp_path, COCO, frame_ids=("000006", "000007")).segment(FRAME)
    np.testing.assert_array_equal(found.class_ids, expected())


@pytest.mark.parametrize("form", ["document", "results", "folder"])
def test_masks_of_several_cameras_are_told_apart_by_their_file_names(
    tmp_path: Path, form: str
) -> None:
    """CAMERA/FRAME; a frame with one camera does not get the masks of all."""
    if form == "document":
        images = [
            {"id": 1, "file_name": "samples/front/000007.jpg"},
            {"id": 2, "file_name": "samples/back/000007.jpg"},
        ]
        path = save(
            tmp_path / "a.json",
            {"images": images, "annotations": [CAR | {"image_id": 1}, PERSON | {"image_id": 2}]},
        )
    elif form == "results":
        objects = [CAR | {"image_id": "front/000007"}, PERSON | {"image_id": "back/000007"}]
        path = save(tmp_path / "a.json", objects)
    else:
        path = tmp_path / "masks"
        for camera, each in (("front", CAR), ("back", PERSON)):
            (path / camera).mkdir(parents=True)
            save(path / camera / "000007.json", [each])
    segmenter = InstanceSegmenter(path, COCO)
    front = segmenter.segment(replace(FRAME, camera="front")).class_ids
    back = segmenter.segment(replace(FRAME, camera="back")).class_ids
    assert (3 in front, 1 in front) == (True, False)
    assert (3 in back, 1 in back) == (False, True)
    with pytest.raises(DataError):
        segmenter.segment(FRAME)


def test_masks_of_several_cameras_are_matched_to_the_frames_of_the_data_set(tmp_path: Path) -> None:
    """Two images of one frame are no contradiction if they are of two cameras."""
    images = [{"id": i, "file_name": f"{each}/000007.jpg"} for i, each in enumerate(("a", "b"))]
    objects = [CAR | {"image_id": 0}, PERSON | {"image_id": 1}]
    path = save(tmp_path / "a.json", {"images": images, "annotations": objects})
    segmenter = InstanceSegmenter(path, COCO, frame_ids=("000007",))
    assert 3 in segmenter.segment(replace(FRAME, camera="a")).class_ids
    assert 1 in segmenter.segment(replace(FRAME, camera="b")).class_ids
    with pytest.raises(DataError, match="are both frame 000007"):
        segmenter.segment(FRAME)
