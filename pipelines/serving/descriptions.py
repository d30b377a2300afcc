"""What the pages say of databases, tables, columns and questions, from the models themselves."""

import inspect
from collections.abc import Sequence
from typing import Any

from curate.exporters.columns import WEIGHTED_LABELS
from curate.priors.base import Column
from db.evidence import Declaration, label_columns
from db.models import Base
from pipelines.queries.named_queries import named_queries

# What a page adds to the meaning of a column.
_LEADS_TO = {"frame": "its picture", "k": "why it has its weight"}
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


def working_database(declared: Sequence[Declaration] = ()) -> dict[str, Any]:
    """Datasette's metadata of a workspace's database, with what its evidence sources declare."""
    tables = {model.__tablename__: _of_model(model) for model in Base.__subclasses__()}
    tables["alembic_version"] = {"hidden": True}
    tables["frame"]["label_column"] = "frame"
    for name, told in _VIEWS.items():
        tables[name] = {"description": told}
    tables["weighted_labels"]["columns"] = _weighted_labels(label_columns(declared))
    for each in declared:
        tables[each.table] = {
            "description": f"Evidence of the source '{each.name}'.",
            "columns": _meanings(each.columns),
        }
    return {
        "description": "Predictions, their evidence, their weights, and what was done",
        "tables": tables,
        "queries": _query_meanings(exported=False),
    }


def exported_file() -> dict[str, Any]:
    """Datasette's metadata of an exported label file."""
    tables: dict[str, Any] = {name: {"description": told} for name, told in _EXPORTED.items()}
    tables["weighted_labels"] = {"description": _VIEWS["weighted_labels"]}
    for name in ("label", "weighted_labels"):
        tables[name]["columns"] = _weighted_labels(WEIGHTED_LABELS)
    return {
        "description": "The exported weighted labels that a training reads",
        "tables": tables,
        "queries": _query_meanings(exported=True),
    }


def _weighted_labels(columns: Sequence[Column]) -> dict[str, str]:
    """The columns of the weighted labels, with their units."""
    return {
        name: meaning + (f"; leads to {_LEADS_TO[name]}" if name in _LEADS_TO else "")
        for name, meaning in _meanings(columns).items()
    }


def _meanings(columns: Sequence[Column]) -> dict[str, str]:
    """What each column means, with its unit."""
    return {
        column.name: column.meaning + (f" [{column.unit}]" if column.unit not in ("", "1") else "")
        for column in columns
    }


def _of_model(model: type[Base]) -> dict[str, Any]:
    columns = Base.metadata.tables[model.__tablename__].columns
    return {
        "description": " ".join((inspect.getdoc(model) or "").split()),
        "columns": {column.name: column.comment for column in columns if column.comment},
    }


def _query_meanings(*, exported: bool) -> dict[str, Any]:
    """The named queries that a database can answer."""
    return {
        name: {"title": name, "description": f"{query.description}.", "sql": query.sql}
        for name, query in named_queries().items()
        if query.exported or not exported
    }
