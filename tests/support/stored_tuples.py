"""Rows that tests write as tuples, with their column names."""

from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy import Connection

from db import bulk

BOX = ("x", "y", "z", "length", "width", "height", "yaw")
KEY = ("round", "frame_id", "k")
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "frame": (
        *("dataset", "frame", "split"),
        *("points_path", "image_path", "calibration_path", "label_path"),
    ),
    "round": ("number", "rounds", "teacher_id", "config", "code_version", "seed"),
    "ground_truth": (
        *("frame_id", "k", "split", "category", *BOX, "truncated", "occluded", "alpha"),
        *("image_left", "image_top", "image_right", "image_bottom"),
    ),
    "prediction": (*KEY, "category", "score", *BOX, "iou"),
    "consistency": (*KEY, "loss", "views", "matched_views"),
    "point_prior": (*KEY, "points", "points_threshold", "rho_diff"),
    "semantic_prior": (*KEY, "mask_pixels", "box_pixels", "rho_anno"),
    "weight": (*KEY, "policy", "lambda_u", "rho_det", "v"),
    "label_count": ("round", "policy", "category", "labels", "kept", "trusted", "weight"),
    "human_label": (
        *("frame_id", "n", "split", "review", "item", "decision", "category", "from_round"),
        *BOX,
        *(f"seen_{name}" for name in BOX),
        *("reviewer", "decided_at"),
    ),
}


def as_columns(table: str, rows: Iterable[tuple]) -> dict[str, list[Any]]:
    """Return the rows by column name."""
    rows, names = list(rows), COLUMNS[table]
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def store(connection: Connection, table: str, rows: Iterable[tuple]) -> None:
    """Insert rows of `COLUMNS`."""
    bulk.insert(connection, table, as_columns(table, rows))
