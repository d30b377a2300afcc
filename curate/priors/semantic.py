"""The semantic prior rho_anno (Eq. 9): the image should show the label's class where the box lies.

Source: An et al., Remote Sensing 15(3):627, 2023. Its prose says "arithmetic mean" of the score and
the share of class pixels, its printed formula is a square root: geometric is the default here.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args

import numpy as np

from curate.detections import Detections
from curate.errors import ConfigError, ModelError
from curate.frames import Frame
from curate.geometry.projection import image_rectangles
from curate.priors.base import Column, Evidence, EvidenceSource, Measured
from curate.segmenters.base import Segmenter, SemanticMap
from curate.shapes import Float, Int, Num, Shaped

Mean = Literal["geometric", "product", "arithmetic"]
Outside = Literal["neutral", "drop"]


@dataclass(frozen=True)
class SemanticSettings:
    """How score s and class share S/A become rho_anno.

    Attributes:
        mean: "geometric" sqrt(s S/A), "product" s S/A, "arithmetic" (s + S/A) / 2.
        outside: for a box that the image does not show, "neutral" gives rho_anno = s, "drop" 0.
    """

    mean: Mean = "geometric"
    outside: Outside = "neutral"

    def __post_init__(self) -> None:
        """Raise ConfigError for an unknown option."""
        for value, kind, noun in ((self.mean, Mean, "mean"), (self.outside, Outside, "outside")):
            if value not in get_args(kind):
                known = ", ".join(get_args(kind))
                raise ConfigError(
                    f"semantic prior: unknown {noun} {value!r}; choose one of {known}"
                )


_DEFAULT = SemanticSettings()


@dataclass(frozen=True)
class SemanticPrior(EvidenceSource):
    """rho_anno = sqrt(s * S / A) with the semantic map of a segmenter.

    Attributes:
        segmenter: names the class of every pixel; None for a prior that only rates.
        settings: see `SemanticSettings`.
    """

    segmenter: Segmenter | None
    settings: SemanticSettings = _DEFAULT
    name: ClassVar[str] = "semantic"
    columns: ClassVar[tuple[Column, ...]] = (
        Column("mask_pixels", "int64", "px", "S, pixels of the category in the projected box"),
        Column("box_pixels", "int64", "px", "A, pixels of the projected box"),
        Column("rho_anno", "float64", "1", "semantic prior, Eq. 9, from s, S and A"),
    )
    rho_column: ClassVar[str | None] = "rho_anno"
    measured_columns: ClassVar[tuple[str, ...]] = ("mask_pixels", "box_pixels")

    @property
    def needs_image(self) -> bool:
        """Whether the segmenter reads the image."""
        return self.segmenter is not None and self.segmenter.needs_image

    @property
    def needs_points(self) -> bool:
        """Whether the segmenter reads the points; one that does not say so may."""
        return bool(getattr(self.segmenter, "needs_points", self.segmenter is not None))

    def measure(self, frame: Frame, detections: Detections) -> Measured:
        """Segment the frame and look at each box's rectangle; no label, no segmentation.

        Raises:
            ConfigError: if there is no segmenter, or it has no classes for a detection's category.
            ModelError: if the semantic map is not in the size of the image.
        """
        if self.segmenter is None:
            raise ConfigError("semantic prior: pixels cannot be counted without a segmenter")
        if len(detections) == 0:
            return dict.fromkeys(self.measured_columns, np.zeros(0, dtype=np.int64))
        semantic_map = self.segmenter.segment(frame)
        width, height = frame.image_size
        if semantic_map.class_ids.shape != (height, width):
            shown = " x ".join(str(side) for side in semantic_map.class_ids.shape[::-1])
            raise ModelError(
                f"frame {frame.frame_id}: the semantic map is {shown}, the image {width} x "
                f"{height} pixels; make the segmenter answer in the size of the image",
            )
        rectangles = image_rectangles(detections.boxes, frame.calibration, frame.image_size)
        counts = count_pixels(rectangles, detections.categories, semantic_map)
        return dict(zip(self.measured_columns, counts, strict=True))

    def rate(self, detections: Detections, measured: Measured) -> Evidence:
        """Return S, A and what follows from them by equation 9."""
        mask_pixels, box_pixels = (measured[name] for name in self.measured_columns)
        rho = semantic_trust(detections.scores, mask_pixels, box_pixels, self.settings)
        return {"mask_pixels": mask_pixels, "box_pixels": box_pixels, "rho_anno": rho}

    def describe(self, row: Mapping[str, Any]) -> str:
        """Return Eq. 9 with the numbers of a label."""
        formula = {
            "geometric": "sqrt(s S/A)", "product": "s S/A", "arithmetic": "(s + S/A) / 2",
        }[self.settings.mean]  # fmt: skip
        numbers = "s = {score}, S = {mask_pixels}, A = {box_pixels} pixels = {rho_anno}"
        return f"Eq. 9: rho_anno = {formula} with {numbers}".format(**row)


def semantic_trust(
    scores: Float[np.ndarray, " n"],
    mask_pixels: Num[np.ndarray, " n"],
    box_pixels: Num[np.ndarray, " n"],
    settings: SemanticSettings = _DEFAULT,
) -> Float[np.ndarray, " n"]:
    """rho_anno (Eq. 9) from (n,) scores and (n,) pixel counts S and A."""
    share = mask_pixels / np.maximum(box_pixels, 1)
    if settings.mean == "geometric":
        rho = np.sqrt(scores * share)
    elif settings.mean == "product":
        rho = scores * share
    else:
        rho = (scores + share) / 2
    return np.where(box_pixels > 0, rho, scores if settings.outside == "neutral" else 0.0)


def count_pixels(
    rectangles: Float[np.ndarray, "n 4"],
    categories: Shaped[np.ndarray, " n"],
    semantic_map: SemanticMap,
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """S and A of each rectangle: a pixel counts where the rectangle touches any part of it.

    As in KITTI, pixel (row r, column c) is centred on the coordinates (c, r) and the whole image is
    the rectangle 0, 0, width - 1, height - 1. The columns of a rectangle are therefore left to
    right, both rounded (halves up) and both included, as far as the image has them; rows likewise.

    Args:
        rectangles: (n, 4) left, top, right, bottom in pixels, NaN where the image shows nothing.
        categories: (n,) str.
        semantic_map: see `SemanticMap`.

    Returns:
        (n,) int64 pixels of the category's classes, (n,) int64 pixels.

    Raises:
        ConfigError: if the semantic map has no classes for a category.
    """
    height, width = semantic_map.class_ids.shape
    seen = ~np.isnan(rectangles).any(axis=1)
    nearest = np.floor(np.where(seen[:, None], rectangles, 0.0) + 0.5)
    left, top = np.clip(nearest[:, :2], 0, (width, height)).astype(np.int64).T
    right, bottom = np.clip(nearest[:, 2:] + 1, 0, (width, height)).astype(np.int64).T
    box_pixels = np.where(seen, (right - left) * (bottom - top), 0)
    mask_pixels = np.zeros(len(rectangles), dtype=np.int64)
    for category in np.unique(categories):
        k = np.flatnonzero(seen & (categories == category))
        counted = _classes(semantic_map, str(category))
        if len(k) == 0:
            continue
        # Only what the category's rectangles cover together is looked at.
        row, column = top[k].min(), left[k].min()
        part = semantic_map.class_ids[row : bottom[k].max(), column : right[k].max()]
        total = _integral(part, counted)
        above, below = top[k] - row, bottom[k] - row
        before, after = left[k] - column, right[k] - column
        mask_pixels[k] = (
            total[below, after] - total[above, after] - total[below, before] + total[above, before]
        )
    return mask_pixels, box_pixels


def _integral(class_ids: np.ndarray, counted: Collection[int]) -> np.ndarray:
    """(h + 1, w + 1) class pixels above and left of each pixel corner of a (h, w) part of a map."""
    import cv2

    counts = np.zeros(256, dtype=np.uint8)
    counts[list(counted)] = 1
    if class_ids.size == 0:
        return np.zeros([side + 1 for side in class_ids.shape], dtype=np.int32)
    return np.asarray(cv2.integral(cv2.LUT(class_ids, counts)))


def _classes(semantic_map: SemanticMap, category: str) -> tuple[int, ...]:
    if category not in semantic_map.category_classes:
        raise ConfigError(
            f"semantic prior: the segmenter has no classes for category {category}; "
            "name the class ids that count for it in the segmenter's class table",
        )
    return semantic_map.category_classes[category]
