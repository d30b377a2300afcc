"""The semantic prior rho_anno (Eq. 9): share of the box's image area that shows the label's class.

Source: An et al., Remote Sensing 15(3):627, 2023. Its text says "arithmetic mean" of the score and
the share of class pixels, but its formula is a square root. The default here is the geometric mean.

Even a perfect box has S/A below 1, because its rectangle contains background, and segmenters miss
part of small or distant objects. With a reference r(c), the upper quartile of S/A over the labeled
boxes of category c, the prior uses min(1, (S/A) / r(c)) in place of S/A.
"""

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from curate.detections import Annotations, Detections
from curate.errors import ConfigError, ModelError
from curate.frames import Frame
from curate.geometry.projection import camera_of_boxes, image_rectangles
from curate.priors.base import Column, Evidence, EvidenceSource, Measured
from curate.ranges import AboveZero
from curate.segmenters.base import Segmenter, SemanticMap, image_size_of
from curate.shapes import Float, Int, Num, Shaped

logger = logging.getLogger(__name__)

Mean = Literal["geometric", "product", "arithmetic"]
Outside = Literal["expected", "neutral", "drop"]

EXPECTED_SHARE = 0.7
"""S/A of a correct label that no camera shows: the median of correct labels on KITTI's frames."""
REFERENCE_QUANTILE = 0.75
"""Quantile of S/A over the labeled boxes of a category that is its reference."""
MINIMUM_REFERENCE = 0.15
"""A lower reference is not used: the segmenter hardly sees the category, so S/A is mostly noise."""


@dataclass(frozen=True)
class SemanticSettings:
    """Settings that combine score s and class share S/A into rho_anno.

    Attributes:
        mean: "geometric" for sqrt(s S/A), "product" for s S/A, "arithmetic" for (s + S/A) / 2.
        outside: rho_anno of a box that no camera shows: 0.7 s^2 for "expected", s for "neutral", 0
            for "drop". The first is s times the expected share, which is 0.7 for a correct label;
            s takes the place of the probability that the label is correct.
    """

    mean: Mean = "geometric"
    outside: Outside = "expected"

    def __post_init__(self) -> None:
        """Raise ConfigError for an unknown option."""
        for value, kind, noun in ((self.mean, Mean, "mean"), (self.outside, Outside, "outside")):
            if value not in get_args(kind):
                choices = ", ".join(get_args(kind))
                raise ConfigError(
                    f"semantic prior: unknown {noun} {value!r}; choose one of {choices}"
                )


_DEFAULT = SemanticSettings()


@dataclass(frozen=True)
class ShareReference:
    """The reference of a category, from X_l.

    Attributes:
        boxes: number of labeled boxes of the category that an image shows.
        upper_quartile: upper quartile of their S/A; None without such a box.
    """

    boxes: int
    upper_quartile: float | None


@dataclass(frozen=True)
class SemanticPrior(EvidenceSource):
    """rho_anno = sqrt(s * S / A) with the semantic map of a segmenter.

    Attributes:
        segmenter: provides the semantic map; None for a prior that only rates.
        settings: see `SemanticSettings`.
        references: r(c) per category, in (0, 1]; S/A of other categories is used as it is.
    """

    segmenter: Segmenter | None
    settings: SemanticSettings = _DEFAULT
    references: Mapping[str, AboveZero] = field(default_factory=dict)
    name: ClassVar[str] = "semantic"
    columns: ClassVar[tuple[Column, ...]] = (
        Column("mask_pixels", "int64", "px", "S, pixels of the category in the projected box"),
        Column("box_pixels", "int64", "px", "A, pixels of the projected box"),
        Column("rho_anno", "float64", "1", "semantic prior, Eq. 9, from s, S and A"),
    )
    rho_column: ClassVar[str | None] = "rho_anno"
    further_columns: ClassVar[tuple[Column, ...]] = (
        Column(
            "camera",
            "name",
            "",
            "the camera that shows most of the box; null if none shows it",
            optional=True,
        ),
        Column(
            "share_reference",
            "float64",
            "1",
            "upper quartile of S/A over labeled boxes, by which S/A is divided; null if it is not",
            optional=True,
        ),
    )
    measured_columns: ClassVar[tuple[str, ...]] = ("mask_pixels", "box_pixels")

    @property
    def needs_image(self) -> bool:
        """Whether the segmenter reads the image."""
        return self.segmenter is not None and self.segmenter.needs_image

    @property
    def needs_points(self) -> bool:
        """Whether the segmenter reads the points; assumed if it does not declare it."""
        return bool(getattr(self.segmenter, "needs_points", self.segmenter is not None))

    def measure(self, frame: Frame, detections: Detections) -> Measured:
        """Segment the frame and count the pixels of each projected box.

        Of several cameras, the one that shows most of a box counts, see `camera_of_boxes`. An image
        that counts for no box is not segmented.

        Raises:
            ConfigError: if there is no segmenter or no camera, or the segmenter has no classes for
                a detection's category.
            ModelError: if the size of the semantic map differs from the image size.
        """
        if self.segmenter is None:
            raise ConfigError("semantic prior: pixels cannot be counted without a segmenter")
        if not frame.cameras:
            raise ConfigError(
                f"frame {frame.frame_id} has no camera, so the semantic prior cannot be computed; "
                "leave 'semantic' out of run.priors"
            )
        counts = np.zeros((2, len(detections)), dtype=np.int64)
        names = np.full(len(detections), None, dtype=object)
        chosen = camera_of_boxes(detections.boxes, frame.cameras)
        for number, view in enumerate(frame.views()):
            shown = np.flatnonzero(chosen == number)
            if len(shown):
                counts[:, shown] = self._count(view, detections.select(shown))
                names[shown] = view.camera or None
        measured = dict(zip(self.measured_columns, counts, strict=True))
        return measured | {"camera": names} if len(frame.cameras) > 1 else measured

    def _count(self, view: Frame, shown: Detections) -> tuple[np.ndarray, np.ndarray]:
        """Return S and A of labels in the image of a frame with one camera."""
        if self.segmenter is None:
            raise ConfigError("semantic prior: pixels cannot be counted without a segmenter")
        semantic_map = self.segmenter.segment(view)
        width, height = size = image_size_of(view)
        if semantic_map.class_ids.shape != (height, width):
            map_size = " x ".join(str(side) for side in semantic_map.class_ids.shape[::-1])
            raise ModelError(
                f"frame {view.frame_id}: the semantic map has {map_size} pixels, the image "
                f"{width} x {height}; the segmenter must return a map of the image size",
            )
        rectangles = image_rectangles(shown.boxes, view.calibration, size)
        return count_pixels(rectangles, shown.categories, semantic_map)

    def rate(self, detections: Detections, measured: Measured) -> Evidence:
        """Return S, A and rho_anno (Eq. 9), and the references if there are any."""
        mask_pixels, box_pixels = measured["mask_pixels"], measured["box_pixels"]
        names = (*self.measured_columns, "camera")
        found = {name: measured[name] for name in names if name in measured}
        if not self.references:
            rho = semantic_trust(detections.scores, mask_pixels, box_pixels, self.settings)
            return {**found, "rho_anno": rho}
        reference = np.array([self.references.get(str(c), np.nan) for c in detections.categories])
        reference = reference.astype(np.float64)
        rho = semantic_trust(detections.scores, mask_pixels, box_pixels, self.settings, reference)
        return {**found, "rho_anno": rho, "share_reference": reference}

    def describe(self, row: Mapping[str, Any]) -> str:
        """Return the rule that gave rho_anno, with the numbers of one label."""
        camera = f"camera {row['camera']}: " if row.get("camera") not in (None, "none") else ""
        if row["box_pixels"] == 0:
            rule = {
                "expected": f"{EXPECTED_SHARE:g} s^2", "neutral": "s", "drop": "0",
            }[self.settings.outside]  # fmt: skip
            outside = f"no image shows the box, so outside = '{self.settings.outside}' applies"
            return f"{outside}: rho_anno = {rule} with s = {{score}} = {{rho_anno}}".format(**row)
        reference = self.references.get(row["category"]) if self.references else None
        share, relative = "S/A", ""
        if reference is not None:
            share, seen = "r", row["mask_pixels"] / row["box_pixels"]
            relative = (
                f"r = min(1, (S/A) / reference) = min(1, {seen:.4f} / {reference:.4f}) = "
                f"{min(1.0, seen / reference):.4f}, "
            )
        formula = {
            "geometric": f"sqrt(s {share})",
            "product": f"s {share}",
            "arithmetic": f"(s + {share}) / 2",
        }[self.settings.mean]
        numbers = "s = {score}, S = {mask_pixels}, A = {box_pixels} pixels = {rho_anno}"
        return f"{camera}Eq. 9: rho_anno = {formula} with {relative}{numbers}".format(**row)


def semantic_trust(
    scores: Float[np.ndarray, " n"],
    mask_pixels: Num[np.ndarray, " n"],
    box_pixels: Num[np.ndarray, " n"],
    settings: SemanticSettings = _DEFAULT,
    references: Float[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, " n"]:
    """Return (n,) rho_anno (Eq. 9).

    Args:
        scores: (n,) s.
        mask_pixels: (n,) S.
        box_pixels: (n,) A; 0 outside the image.
        settings: see `SemanticSettings`.
        references: (n,) upper quartiles of S/A over labeled boxes, by which S/A is divided; NaN
            for labels with an S/A that is used as it is.
    """
    share = mask_pixels / np.maximum(box_pixels, 1)
    if references is not None:
        share = np.where(np.isnan(references), share, np.minimum(share / references, 1.0))
    if settings.mean == "geometric":
        rho = np.sqrt(scores * share)
    elif settings.mean == "product":
        rho = scores * share
    else:
        rho = (scores + share) / 2
    outside = {
        "expected": EXPECTED_SHARE * scores**2, "neutral": scores, "drop": np.zeros(len(scores)),
    }[settings.outside]  # fmt: skip
    return np.where(box_pixels > 0, rho, outside)


def learn_references(
    samples: Iterable[tuple[Frame, Annotations]], categories: Sequence[str], prior: SemanticPrior
) -> dict[str, ShareReference]:
    """Return the reference of each category from labeled frames.

    Boxes that no camera shows do not count.

    Args:
        samples: frames of X_l, never of X_u, with their ground truth.
        categories: categories that need a reference.
        prior: measures S and A.
    """
    shares: dict[str, list[np.ndarray]] = {category: [] for category in categories}
    for frame, annotations in samples:
        has_box = np.isfinite(annotations.boxes).all(axis=1)
        chosen = annotations.select(has_box & np.isin(annotations.categories, list(categories)))
        boxes = Detections(chosen.boxes, np.ones(len(chosen)), chosen.categories)
        measured = prior.measure(frame, boxes)
        seen = measured["box_pixels"] > 0
        share = measured["mask_pixels"][seen] / measured["box_pixels"][seen]
        for category, of_category in shares.items():
            of_category.append(share[chosen.categories[seen] == category])
    merged = {c: np.concatenate([np.zeros(0), *parts]) for c, parts in shares.items()}
    return {
        c: ShareReference(len(s), float(np.quantile(s, REFERENCE_QUANTILE)) if len(s) else None)
        for c, s in merged.items()
    }


def usable_references(found: Mapping[str, ShareReference]) -> dict[str, float]:
    """Return the references that can be used; warn of the categories without one."""
    usable = {}
    for category, each in found.items():
        quartile = each.upper_quartile
        if quartile is not None and quartile >= MINIMUM_REFERENCE:
            usable[category] = quartile
            continue
        reason = (
            f"no labeled box of {category} is inside an image"
            if quartile is None
            else f"the upper quartile of S/A over {each.boxes} labeled boxes of {category} is only "
            f"{quartile:.3g}, below {MINIMUM_REFERENCE:g}; check the segmenter's classes"
        )
        logger.warning("semantic.reference: %s; S/A of %s is used as it is", reason, category)
    return usable


def count_pixels(
    rectangles: Float[np.ndarray, "n 4"],
    categories: Shaped[np.ndarray, " n"],
    semantic_map: SemanticMap,
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Count the class pixels S and all pixels A of each rectangle.

    A pixel counts if the rectangle touches any part of it. As in KITTI, the centre of the pixel in
    row r and column c has the coordinates (c, r), and the whole image is the rectangle 0, 0,
    width - 1, height - 1. A rectangle therefore has the columns from round(left) to round(right),
    both included, clipped to the image; halves are rounded up. The same holds for its rows.

    Args:
        rectangles: (n, 4) left, top, right, bottom in pixels; NaN for boxes outside the image.
        categories: (n,) str.
        semantic_map: see `SemanticMap`.

    Returns:
        (n,) int64 S, pixels of the category's classes, and (n,) int64 A, all pixels.

    Raises:
        ConfigError: if the semantic map has no classes for a category.
    """
    height, width = semantic_map.class_ids.shape
    visible = ~np.isnan(rectangles).any(axis=1)
    rounded = np.floor(np.where(visible[:, None], rectangles, 0.0) + 0.5)
    left, top = np.clip(rounded[:, :2], 0, (width, height)).astype(np.int64).T
    right, bottom = np.clip(rounded[:, 2:] + 1, 0, (width, height)).astype(np.int64).T
    box_pixels = np.where(visible, (right - left) * (bottom - top), 0)
    mask_pixels = np.zeros(len(rectangles), dtype=np.int64)
    for category in np.unique(categories):
        k = np.flatnonzero(visible & (categories == category))
        class_ids = _classes(semantic_map, str(category))
        if len(k) == 0:
            continue
        # The integral image covers only the bounding rectangle of the category's rectangles.
        row, column = top[k].min(), left[k].min()
        part = semantic_map.class_ids[row : bottom[k].max(), column : right[k].max()]
        total = _integral(part, class_ids)
        above, below = top[k] - row, bottom[k] - row
        before, after = left[k] - column, right[k] - column
        mask_pixels[k] = (
            total[below, after] - total[above, after] - total[below, before] + total[above, before]
        )
    return mask_pixels, box_pixels


def _integral(part: np.ndarray, class_ids: Collection[int]) -> np.ndarray:
    """Return the (h + 1, w + 1) integral image of the pixels of some classes.

    Args:
        part: (h, w) uint8 part of a semantic map.
        class_ids: the classes to count.
    """
    import cv2

    is_counted = np.zeros(256, dtype=np.uint8)
    is_counted[list(class_ids)] = 1
    if part.size == 0:
        return np.zeros([side + 1 for side in part.shape], dtype=np.int32)
    return np.asarray(cv2.integral(cv2.LUT(part, is_counted)))


def _classes(semantic_map: SemanticMap, category: str) -> tuple[int, ...]:
    if category not in semantic_map.category_classes:
        raise ConfigError(
            f"semantic prior: the segmenter has no classes for category {category}; "
            "add the class ids of this category to the segmenter's class table",
        )
    return semantic_map.category_classes[category]
