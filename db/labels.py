"""The box of a label in SQL: the fused one if there is one, else that of the prediction."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy import ColumnElement, FromClause, and_, func

from db.models import BOX_COLUMNS, Base

_PREDICTION = Base.metadata.tables["prediction"]
_FUSED = Base.metadata.tables["fused_box"]


def with_fused_boxes(joined: FromClause) -> FromClause:
    """Return tables that include `prediction`, joined with the fused boxes for `label_box`."""
    same = (_FUSED.c[key] == _PREDICTION.c[key] for key in ("round", "frame_id", "k"))
    return joined.outerjoin(_FUSED, and_(*same))


def label_box() -> Mapping[str, ColumnElement[Any]]:
    """Return the columns of the label's box by name, see `with_fused_boxes`."""
    return {
        name: func.coalesce(_FUSED.c[name], _PREDICTION.c[name]).label(name) for name in BOX_COLUMNS
    }
