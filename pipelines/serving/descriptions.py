"""What the pages say of databases, tables, columns and questions, from the models themselves."""

import inspect
from typing import Any

from db.models import Base
from pipelines.named_queries import named_queries

_BOX = "of the box, metres, LiDAR frame"
_WEIGHTED_LABELS = {
    "round": "number of the round",
    "frame": "unlabeled frame; leads to its picture",
    "k": "number of the label in its frame; leads to why it has its weight",
    "category": "what the detector takes it for",
    "x": "centre, metres forward of the LiDAR",
    "y": "centre, metres to its left",
    "z": "centre, metres above it",
    "length": _BOX,
    "width": _BOX,
    "height": _BOX,
    "yaw": "radians, counter-clockwise from x",
    "score": "s, the detector's own",
    "loss": "consistency loss L; null: no reprediction matched, no evidence",
    "points": "m, LiDAR points in the box",
    "points_threshold": "m_th, what labeled boxes of the category hold",
    "rho_diff": "point prior, Eq. 8: min(m, m_th) / m_th",
    "mask_pixels": "S, pixels of the category in the projected box",
    "box_pixels": "A, pixels of the projected box; 0: outside the image",
    "rho_anno": "semantic prior, Eq. 9, from s, S and A",
    "rho_det": "product of the priors",
    "lambda_u": "age parameter, Eq. 4: losses above it weigh nothing",
    "policy": "whose weight",
    "weight": "v, reliability, 0 to 1; 0: ignore this region",
}
_VIEWS = {
    "weighted_labels": "Every label of an unlabeled frame with its evidence, a row per policy.",
    "evaluation": (
        "What became of every object and detection of val frames; `curate evaluate --store` "
        "leaves it."
    ),
    "failed_frames": "Frames that a stage could not do, with the error.",
}
_EXPORTED = {
    "meta": "What the file was made from: data set, categories, round, policy, code version.",
    "frame": "The labeled and unlabeled frames, and where their files lie below meta.root.",
    "ground_truth": "What annotators wrote, for labeled frames only.",
    "label": "The weighted labels; people query them through the view weighted_labels.",
}


def working_database() -> dict[str, Any]:
    """Datasette's metadata of a workspace's database."""
    tables = {model.__tablename__: _of_model(model) for model in Base.__subclasses__()}
    tables["alembic_version"] = {"hidden": True}
    tables["frame"]["label_column"] = "frame"
    for name, told in _VIEWS.items():
        tables[name] = {"description": told}
    tables["weighted_labels"]["columns"] = dict(_WEIGHTED_LABELS)
    return {
        "description": "Predictions, their evidence, their weights, and what was done",
        "tables": tables,
        "queries": _questions(exported=False),
    }


def exported_file() -> dict[str, Any]:
    """Datasette's metadata of an exported label file."""
    tables: dict[str, Any] = {name: {"description": told} for name, told in _EXPORTED.items()}
    tables["weighted_labels"] = {"description": _VIEWS["weighted_labels"]}
    for name in ("label", "weighted_labels"):
        tables[name]["columns"] = dict(_WEIGHTED_LABELS)
    return {
        "description": "The exported weighted labels that a training reads",
        "tables": tables,
        "queries": _questions(exported=True),
    }


def _of_model(model: type[Base]) -> dict[str, Any]:
    columns = Base.metadata.tables[model.__tablename__].columns
    return {
        "description": " ".join((inspect.getdoc(model) or "").split()),
        "columns": {column.name: column.comment for column in columns if column.comment},
    }


def _questions(*, exported: bool) -> dict[str, Any]:
    """The named queries that a database can answer."""
    return {
        name: {"title": name, "description": f"{query.description}.", "sql": query.sql}
        for name, query in named_queries().items()
        if query.exported or not exported
    }
