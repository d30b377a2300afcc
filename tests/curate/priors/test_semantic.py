"""The semantic prior: counting pixels, and Eq. 9."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from oracles import pixels

from curate.detections import Annotations, Detections, as_categories
from curate.errors import ConfigError, ModelError
from curate.frames import Calibration, Camera, Frame
from curate.priors.base import check_evidence
from curate.priors.semantic import (
    SemanticPrior,
    SemanticSettings,
    ShareReference,
    count_pixels,
    learn_references,
    semantic_trust,
    usable_references,
)
from curate.segmenters.base import SemanticMap

WIDTH, HEIGHT = 80, 40
CLASSES = {"Car": (7,), "Pedestrian": (15,), "Cyclist": (2, 15)}
# A camera at the origin that looks along x, 40 pixels per unit of slope.
CALIBRATION = Calibration(
    projection=np.array([[40.0, 0, 40, 0], [0, 40.0, 20, 0], [0, 0, 1, 0]]),
    lidar_to_camera=np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
)
AHEAD = [10.0, 0.0, 0.0, 2.0, 4.0, 2.0, 0.0]
BEHIND = [-10.0, 0.0, 0.0, 2.0, 4.0, 2.0, 0.0]


@dataclass(frozen=True)
class Painted:
    """A segmenter that returns one map."""

    class_ids: np.ndarray
    needs_image: bool = False

    def segment(self, frame):
        """Return the map for every frame."""
        return SemanticMap(self.class_ids, CLASSES)


def frame():
    """Return a frame without points."""
    return Frame("000007", np.zeros((0, 4), np.float32), CALIBRATION, (WIDTH, HEIGHT))


def labels(boxes, scores, categories=None):
    """Return labels of cars by default."""
    names = ["Car"] * len(boxes) if categories is None else categories
    return Detections(np.reshape(boxes, (-1, 7)), np.array(scores), as_categories(names))


def test_evidence_counts_class_pixels_in_the_projected_rectangle():
    """A car ahead: its near face spans 17.8 by 8.9 pixels around the centre of the image."""
    class_ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    class_ids[:, 40:] = 7
    found = SemanticPrior(Painted(class_ids)).score(frame(), labels([AHEAD], [0.81]))
    # Columns 31.1 to 48.9 and rows 15.6 to 24.4: pixels 31..49 and 16..24.
    assert found["box_pixels"].tolist() == [19 * 9]
    assert found["mask_pixels"].tolist() == [10 * 9]
    assert found["rho_anno"][0] == pytest.approx(np.sqrt(0.81 * 10 / 19))


@pytest.mark.parametrize(
    ("mean", "expected"),
    [("geometric", np.sqrt(0.64 * 0.25)), ("product", 0.16), ("arithmetic", 0.445)],
)
def test_each_mean_has_its_value(mean, expected):
    """Score 0.64, a quarter of the pixels."""
    rho = semantic_trust(
        np.array([0.64]), np.array([5]), np.array([20]), SemanticSettings(mean=mean)
    )
    assert rho[0] == pytest.approx(expected)


@pytest.mark.parametrize("mean", ["geometric", "product", "arithmetic"])
@pytest.mark.parametrize(("outside", "expected"), [("neutral", 0.3), ("drop", 0.0)])
def test_boxes_outside_the_image(mean, outside, expected):
    """Behind the camera: rho_anno is the score or 0, whichever mean; other boxes do not change."""
    prior = SemanticPrior(
        Painted(np.full((HEIGHT, WIDTH), 7, np.uint8)), SemanticSettings(mean, outside)
    )
    found = prior.score(frame(), labels([BEHIND, AHEAD], [0.3, 1.0]))
    assert found["box_pixels"][0] == found["mask_pixels"][0] == 0
    assert found["rho_anno"].tolist() == [expected, 1.0]


@settings(max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(
        st.tuples(
            *[st.floats(-3.0, 15.0, width=32)] * 4,
            st.sampled_from(sorted(CLASSES)),
        ),
        min_size=1,
        max_size=6,
    ),
)
@example(0, [(0.0, 0.0, 11.0, 8.0, "Cyclist"), (3.5, 2.5, 3.5, 2.5, "Car")])
def test_counting_agrees_with_counting_one_by_one(seed, rows):
    """Integral images against a loop over all pixels, fractional and overhanging rectangles."""
    class_ids = np.random.default_rng(seed).choice(
        np.array([0, 2, 7, 15, 255], np.uint8), size=(9, 12)
    )
    rectangles = np.array([[min(a, c), min(b, d), max(a, c), max(b, d)] for a, b, c, d, _ in rows])
    names = as_categories([row[4] for row in rows])
    mask_pixels, box_pixels = count_pixels(rectangles, names, SemanticMap(class_ids, CLASSES))
    expected = [
        pixels.count(rectangle, class_ids, CLASSES[str(name)])
        for rectangle, name in zip(rectangles, names, strict=True)
    ]
    assert list(zip(mask_pixels.tolist(), box_pixels.tolist(), strict=True)) == expected


def test_the_whole_image_has_all_its_pixels():
    """The rectangle 0, 0, width - 1, height - 1 contains every pixel once."""
    everything = np.array([[0.0, 0.0, WIDTH - 1.0, HEIGHT - 1.0]])
    semantic_map = SemanticMap(np.full((HEIGHT, WIDTH), 7, np.uint8), CLASSES)
    mask_pixels, box_pixels = count_pixels(everything, as_categories(["Car"]), semantic_map)
    assert mask_pixels.tolist() == box_pixels.tolist() == [WIDTH * HEIGHT]


@given(
    st.lists(
        st.tuples(st.floats(0, 1), st.integers(0, 50), st.integers(0, 50)), min_size=1, max_size=9
    ),
    st.sampled_from(["geometric", "product", "arithmetic"]),
    st.sampled_from(["neutral", "drop"]),
)
def test_trust_is_within_0_and_1_and_rises_with_the_pixels(rows, mean, outside):
    """Any score and counts; one more class pixel never lowers rho_anno."""
    scores = np.array([row[0] for row in rows])
    box_pixels = np.array([row[1] + row[2] for row in rows])
    mask_pixels = np.array([row[1] for row in rows])
    options = SemanticSettings(mean, outside)
    rho = semantic_trust(scores, mask_pixels, box_pixels, options)
    more = semantic_trust(scores, np.minimum(mask_pixels + 1, box_pixels), box_pixels, options)
    assert ((rho >= 0) & (rho <= 1)).all()
    assert (more >= rho).all()


def test_evidence_declares_its_columns():
    """The fields are the columns of the database, and rho is the declared trust."""
    prior = SemanticPrior(Painted(np.zeros((HEIGHT, WIDTH), np.uint8)))
    found = prior.score(frame(), labels([AHEAD], [0.5]))
    assert list(found) == ["mask_pixels", "box_pixels", "rho_anno"]
    assert prior.rho_column in found


@pytest.mark.parametrize("needs_image", [True, False])
def test_the_prior_needs_the_inputs_of_its_segmenter(needs_image):
    """Images are read only if they are needed."""
    assert SemanticPrior(Painted(np.zeros((1, 1)), needs_image)).needs_image is needs_image


def test_an_empty_frame_is_not_segmented():
    """Without labels the segmenter, which may be slow, is not called."""
    found = SemanticPrior(Painted(np.zeros((1, 1)))).score(frame(), Detections.empty())
    assert [len(column) for column in found.values()] == [0, 0, 0]


def test_a_map_of_another_size_is_rejected():
    """The error contains the frame and both sizes."""
    prior = SemanticPrior(Painted(np.zeros((HEIGHT, WIDTH - 1), np.uint8)))
    with pytest.raises(ModelError, match=r"000007.*79 x 40.*80 x 40"):
        prior.score(frame(), labels([AHEAD], [0.5]))


def test_a_category_without_classes_is_rejected():
    prior = SemanticPrior(Painted(np.zeros((HEIGHT, WIDTH), np.uint8)))
    with pytest.raises(ConfigError, match="Tram"):
        prior.score(frame(), labels([AHEAD], [0.5], ["Tram"]))


@pytest.mark.parametrize("wrong", [{"mean": "harmonic"}, {"outside": "guess"}])
def test_unknown_options_are_rejected(wrong):
    """The error lists the known ones."""
    with pytest.raises(ConfigError, match=r"choose one of"):
        SemanticSettings(**wrong)


def several():
    """Return a frame with the camera above and one that looks back, with other pixels."""
    turned = CALIBRATION.lidar_to_camera @ np.diag([-1.0, -1, 1, 1])
    cameras = [
        Camera("front", CALIBRATION, (WIDTH, HEIGHT)),
        Camera("back", Calibration(CALIBRATION.projection, turned), (WIDTH, HEIGHT)),
    ]
    return frame().with_cameras(cameras)


@dataclass(frozen=True)
class PaintedByCamera:
    """A segmenter that returns the map of each camera, and records which it was asked for."""

    maps: dict
    asked: list
    needs_image: bool = False

    def segment(self, view):
        """Return the map of the frame's only camera."""
        assert len(view.cameras) == 1
        self.asked.append(view.camera)
        return SemanticMap(self.maps[view.camera], CLASSES)


def test_a_label_counts_the_pixels_of_the_camera_that_shows_it():
    """Labels of every direction have image evidence; the name of the camera is stored."""
    front, back = np.zeros((2, HEIGHT, WIDTH), np.uint8)
    front[:], back[:, :40] = 7, 7
    segmenter = PaintedByCamera({"front": front, "back": back}, [])
    above = [0.0, 0.0, 50.0, 2.0, 4.0, 2.0, 0.0]
    detections = labels([AHEAD, BEHIND, above], [0.81, 0.81, 0.6])
    found = SemanticPrior(segmenter).score(several(), detections)
    assert list(found) == ["mask_pixels", "box_pixels", "camera", "rho_anno"]
    assert found["camera"].tolist() == ["front", "back", None]
    one = SemanticPrior(Painted(front)).score(frame(), labels([AHEAD], [0.81]))
    for name in ("mask_pixels", "box_pixels", "rho_anno"):
        assert found[name][0] == one[name][0]
    assert found["box_pixels"][1] == found["box_pixels"][0]
    assert 0 < found["mask_pixels"][1] < found["box_pixels"][1]
    assert found["box_pixels"][2] == 0
    stored = check_evidence(SemanticPrior(segmenter), found, 3)
    assert stored["camera"] == ["front", "back", None]
    again = SemanticPrior(None).rate(detections, {k: found[k] for k in list(found)[:3]})
    np.testing.assert_array_equal(again["rho_anno"], found["rho_anno"])


def test_only_images_that_count_for_a_label_are_segmented():
    """Six images need six times as long."""
    segmenter = PaintedByCamera({"back": np.zeros((HEIGHT, WIDTH), np.uint8)}, [])
    SemanticPrior(segmenter).measure(several(), labels([BEHIND], [0.5]))
    assert segmenter.asked == ["back"]


def test_a_frame_without_camera_is_rejected():
    """The message says which setting to change."""
    alone = Frame("000007", np.zeros((0, 4), np.float32), CALIBRATION, None)
    with pytest.raises(ConfigError, match=r"000007 has no camera.*leave 'semantic' out"):
        SemanticPrior(Painted(np.zeros((1, 1)))).measure(alone, labels([AHEAD], [0.5]))


@pytest.mark.parametrize(
    ("outside", "rho", "rule"),
    [
        ("expected", 0.7 * 0.64, "rho_anno = 0.7 s^2 with s = 0.8000"),
        ("neutral", 0.8, "rho_anno = s with s = 0.8000"),
        ("drop", 0.0, "rho_anno = 0 with s = 0.8000"),
    ],
)
def test_the_rule_for_a_label_outside_the_image_is_explained(outside, rho, rule):
    """Never as a share of no pixels."""
    prior = SemanticPrior(None, SemanticSettings(outside=outside))
    nothing = {"mask_pixels": np.zeros(1, int), "box_pixels": np.zeros(1, int)}
    found = prior.rate(labels([BEHIND], [0.8]), nothing)
    np.testing.assert_allclose(found["rho_anno"], [rho])
    row = {"score": "0.8000", "mask_pixels": 0, "box_pixels": 0, "rho_anno": f"{rho:.4f}"}
    text = prior.describe(row)
    assert rule in text
    assert "S/A" not in text
    seen = prior.describe(row | {"mask_pixels": 4, "box_pixels": 9, "camera": "back"})
    assert seen.startswith("camera back: Eq. 9: rho_anno = sqrt(s S/A)")


@given(st.floats(0, 1), st.integers(1, 500), st.integers(0, 500))
def test_a_label_that_no_camera_shows_is_worth_less_than_a_confirmed_one(score, area, mask):
    """Than one of the same score with the expected share of class pixels."""
    mask = min(mask, area)
    scores = np.array([score, score])
    unseen, seen = semantic_trust(scores, np.array([0, mask]), np.array([0, area]))
    assert 0 <= unseen <= 0.7
    assert unseen <= seen or mask / area < 0.7


def truth(boxes, categories):
    """Return ground truth with these boxes."""
    count = len(boxes)
    return Annotations(
        np.reshape(np.array(boxes, dtype=np.float64), (count, 7)), as_categories(categories),
        np.zeros(count), np.zeros(count, np.int64), np.zeros(count), np.zeros((count, 4)),
    )  # fmt: skip


def striped(columns):
    """Return a frame's map: cars in the first columns of the car ahead's rectangle, 31 to 49."""
    class_ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    class_ids[:, 31 : 31 + columns] = 7
    return class_ids


def test_a_reference_is_the_upper_quartile_of_labeled_boxes_in_the_image():
    """S/A of 2, 6, 10 and 14 of 19 columns; boxes behind, without a box or of a van are left out.

    The upper quartile of four values lies a quarter of the way from the third to the fourth: 11/19.
    """
    nothing = [np.nan] * 7
    boxes = truth([AHEAD, BEHIND, nothing, AHEAD], ["Car", "Car", "Car", "Van"])
    for columns in (6, 14, 2, 10):
        prior = SemanticPrior(Painted(striped(columns)))
        each = learn_references([(frame(), boxes)], ("Car", "Pedestrian"), prior)
        assert each["Car"] == ShareReference(1, pytest.approx(columns / 19))

    class Frames:
        """A segmenter with a map for each frame in turn."""

        needs_image = False

        def __init__(self):
            self.maps = [striped(columns) for columns in (6, 14, 2, 10)]

        def segment(self, _frame):
            return SemanticMap(self.maps.pop(), CLASSES)

    four = learn_references([(frame(), boxes)] * 4, ("Car", "Pedestrian"), SemanticPrior(Frames()))
    assert four["Car"] == ShareReference(4, pytest.approx(11 / 19))
    assert four["Pedestrian"] == ShareReference(0, None)


def test_each_camera_counts_its_own_boxes():
    """The box behind is seen by the camera that looks back."""
    back = striped(19)
    segmenter = PaintedByCamera({"front": striped(0), "back": back}, [])
    boxes = truth([AHEAD, BEHIND], ["Car", "Car"])
    found = learn_references([(several(), boxes)], ("Car",), SemanticPrior(segmenter))
    behind = SemanticPrior(segmenter).measure(several(), labels([BEHIND], [1.0]))
    share = behind["mask_pixels"][0] / behind["box_pixels"][0]
    assert found["Car"] == ShareReference(2, pytest.approx(0.75 * share))


@pytest.mark.parametrize(
    ("mean", "rho"),
    [("geometric", np.sqrt(0.81 * 0.5)), ("product", 0.405), ("arithmetic", 0.655)],
)
def test_a_share_is_divided_by_its_reference_and_capped(mean, rho):
    """5 of 20 pixels against 0.5, then 18 of 20, a category without reference, and no pixels."""
    prior = SemanticPrior(None, SemanticSettings(mean=mean), {"Car": 0.5})
    names = ["Car", "Car", "Pedestrian", "Car"]
    measured = {
        "mask_pixels": np.array([5, 18, 5, 0]), "box_pixels": np.array([20, 20, 20, 0]),
    }  # fmt: skip
    found = prior.rate(labels([AHEAD] * 4, [0.81] * 4, names), measured)
    plain = SemanticPrior(None, SemanticSettings(mean=mean)).rate(
        labels([AHEAD] * 4, [0.81] * 4, names), measured
    )
    assert found["rho_anno"][0] == pytest.approx(rho)
    assert found["rho_anno"][1] == pytest.approx(
        {"geometric": 0.9, "product": 0.81, "arithmetic": 0.905}[mean]
    )
    np.testing.assert_array_equal(found["rho_anno"][2:], plain["rho_anno"][2:])
    np.testing.assert_array_equal(found["share_reference"], [0.5, 0.5, np.nan, 0.5])
    assert "share_reference" not in plain
    check_evidence(prior, found, 4)
    row = {"category": "Car", "score": "0.8100", "mask_pixels": 5, "box_pixels": 20,
           "rho_anno": f"{rho:.4f}"}  # fmt: skip
    text = prior.describe(row)
    assert "r = min(1, (S/A) / reference) = min(1, 0.2500 / 0.5000) = 0.5000" in text
    assert text.endswith(f"A = 20 pixels = {rho:.4f}")
    assert "reference" not in prior.describe(row | {"category": "Pedestrian"})


def test_a_low_reference_is_not_used(caplog):
    """Nor a missing one; one line says which categories are left as they are, and why."""
    found = {
        "Car": ShareReference(7, 0.15),
        "Pedestrian": ShareReference(3, 0.149),
        "Cyclist": ShareReference(0, None),
    }
    assert usable_references(found) == {"Car": 0.15}
    low, missing = caplog.messages
    assert "over 3 labeled boxes of Pedestrian is only 0.149, below 0.15" in low
    assert "no labeled box of Cyclist is inside an image; S/A of Cyclist is used as" in missing
