"""Views for people who query, generated from what evidence sources declare.

A view is made anew where the hash of its definition is not the one in `view_definition`.
"""

import hashlib
from collections.abc import Mapping, Sequence

from sqlalchemy import Connection, TableClause, column, inspect, select, table, text

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from db.evidence import Declaration, label_columns, read_declarations
from db.models import BOX_COLUMNS, Base, ViewDefinition

# The view with its core columns, to select from.
WEIGHTED_LABELS = table("weighted_labels", *map(column, WEIGHTED_LABEL_COLUMNS))
_DEFINITIONS = Base.metadata.tables[ViewDefinition.__tablename__]

# A label whose prediction stands: (round, frame_id, k) of w, p and the evidence. The conditions of
# a question reach the tables, and its order an index, only where each part of the union gives the
# column itself, or an expression of the column's type: hence the casts.
_EVIDENCE = """
        LEFT JOIN consistency AS c
            ON c.round = w.round AND c.frame_id = w.frame_id AND c.k = w.k
        LEFT JOIN point_prior AS pp
            ON pp.round = w.round AND pp.frame_id = w.frame_id AND pp.k = w.k
        LEFT JOIN semantic_prior AS sp
            ON sp.round = w.round AND sp.frame_id = w.frame_id AND sp.k = w.k
"""
_FURTHER = """
        LEFT JOIN {table} AS {alias}
            ON {alias}.round = w.round AND {alias}.frame_id = w.frame_id AND {alias}.k = w.k
"""
_PREDICTED = """
               p.k, p.category, p.x, p.y, p.z, p.length, p.width, p.height, p.yaw,
               p.score, c.loss, pp.points, pp.points_threshold, pp.rho_diff,
               sp.mask_pixels, sp.box_pixels, sp.rho_anno, w.rho_det, w.lambda_u
"""
_NULLS = {
    "float64": "CAST(NULL AS DOUBLE PRECISION)", "int32": "CAST(NULL AS INTEGER)",
    "int64": "CAST(NULL AS BIGINT)", "name": "CAST(NULL AS TEXT)",
}  # fmt: skip
_REAL, _INTEGER = _NULLS["float64"], _NULLS["int32"]


# What the policies say where nobody has decided, predictions that people rejected, and what they
# hold for objects. Decisions are few: SQLite, which keeps the order of a CROSS JOIN, walks through
# them first and looks their frames up one by one. A condition on frames alone, the split's for one,
# would make it read all frames into a Bloom filter before the first row, hence the CASE on a k.
# A server finds one frame's labels of all rounds by their key only where it is given the rounds.
def _weighted_labels(further: Sequence[Declaration]) -> str:
    """Return the view with the columns of further sources behind the core ones."""
    aliases = {each: f"s{i}" for i, each in enumerate(further)}
    columns = [(alias, column) for each, alias in aliases.items() for column in each.columns]
    found = "".join(f', {alias}."{column.name}"' for alias, column in columns)
    nothing = "".join(f", {_NULLS[column.kind]}" for _, column in columns)
    evidence = _EVIDENCE + "".join(
        _FURTHER.format(table=each.table, alias=alias) for each, alias in aliases.items()
    )
    return f"""
        SELECT p.round, f.frame, {_PREDICTED}, 'detector' AS provenance, w.policy,
               w.v AS weight{found}
        FROM round AS r
        JOIN weight AS w ON w.round = r.number
        JOIN prediction AS p ON p.round = w.round AND p.frame_id = w.frame_id AND p.k = w.k
        JOIN frame AS f ON f.id = w.frame_id
        {evidence}
        WHERE CASE WHEN w.k >= 0 THEN f.split END = 'unlabeled' AND NOT EXISTS (
            SELECT 1 FROM human_match AS m
            WHERE m.round = w.round AND m.frame_id = w.frame_id AND m.k = w.k
        )
        UNION ALL
        SELECT p.round, (SELECT f.frame FROM frame AS f WHERE f.id = m.frame_id), {_PREDICTED},
               'human', w.policy, CAST(0.0 AS DOUBLE PRECISION){found}
        FROM human_match AS m CROSS JOIN human_label AS h CROSS JOIN weight AS w
        CROSS JOIN prediction AS p
        {evidence}
        WHERE h.frame_id = m.frame_id AND h.n = m.n AND h.decision = 'rejected'
          AND w.round = m.round AND w.frame_id = m.frame_id AND w.k = m.k
          AND p.round = m.round AND p.frame_id = m.frame_id AND p.k = m.k
        UNION ALL
        SELECT r.number, (SELECT f.frame FROM frame AS f WHERE f.id = h.frame_id),
               CAST(COALESCE(m.k, 1000000 + h.n) AS INTEGER), h.category,
               h.x, h.y, h.z, h.length, h.width, h.height, h.yaw,
               CAST(1.0 AS DOUBLE PRECISION), {_REAL}, {_INTEGER}, {_REAL}, {_REAL},
               {_INTEGER}, {_INTEGER}, {_REAL}, {_REAL}, {_REAL},
               'human', t.variant, CAST(1.0 AS DOUBLE PRECISION){nothing}
        FROM human_label AS h CROSS JOIN round AS r CROSS JOIN task AS t
        LEFT JOIN human_match AS m
            ON m.round = r.number AND m.frame_id = h.frame_id AND m.n = h.n AND m.leads = 1
        WHERE h.decision <> 'rejected' AND r.number >= h.from_round
          AND t.round = r.number AND t.stage = 'solve' AND t.frame_id IS NULL
"""  # noqa: S608 - made of constants


_VIEWS = {
    "evaluation": """
        SELECT e.source, f.frame, e.side, e.k, e.category, e.outcome, e.matched_k, e.iou, e.score,
               e.x, e.y, e.z, e.length, e.width, e.height, e.yaw, g.truncated, g.occluded,
               e.overlap, e.difficulty
        FROM evaluation_object AS e
        JOIN frame AS f ON f.id = e.frame_id
        LEFT JOIN ground_truth AS g
            ON e.side = 'object' AND g.frame_id = e.frame_id AND g.k = e.k
    """,
    "failed_frames": """
        SELECT t.round, t.stage, f.frame, f.split, t.error
        FROM task AS t JOIN frame AS f ON f.id = t.frame_id
        WHERE t.state = 'failed'
    """,
}

VIEW_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "evaluation": (
        "evaluation_object.source", "frame.frame",
        *(f"evaluation_object.{name}" for name in (
            "side", "k", "category", "outcome", "matched_k", "iou", "score", *BOX_COLUMNS,
        )),
        "ground_truth.truncated", "ground_truth.occluded",
        "evaluation_object.overlap", "evaluation_object.difficulty",
    ),
    "failed_frames": ("task.round", "task.stage", "frame.frame", "frame.split", "task.error"),
}  # fmt: skip
"""The column of a table behind each column of a view, in the order of the view."""


def weighted_labels(connection: Connection) -> TableClause:
    """Return the view with all its columns, to select from."""
    names = (each.name for each in label_columns(read_declarations(connection)))
    return table("weighted_labels", *map(column, names))


def definitions(connection: Connection) -> Mapping[str, str]:
    """Return the query of each view."""
    return {"weighted_labels": _weighted_labels(read_declarations(connection)), **_VIEWS}


def refresh_views(connection: Connection) -> None:
    """Make the views anew that are not as they are defined now."""
    if not views_are_current(connection):
        drop_views(connection)
        create_views(connection)


def views_are_current(connection: Connection) -> bool:
    """Return whether the views are as they are defined now."""
    current = {name: _hash(query) for name, query in definitions(connection).items()}
    return current == _stored(connection)


def create_views(connection: Connection) -> None:
    """Create every view, and store the hash of its definition."""
    for name, query in definitions(connection).items():
        connection.execute(text(f"CREATE VIEW {name} AS {query}"))
        connection.execute(_DEFINITIONS.insert().values(name=name, sha256=_hash(query)))


def drop_views(connection: Connection) -> None:
    """Drop every view, so that the tables beneath can change."""
    for name in ("weighted_labels", *_VIEWS):
        connection.execute(text(f"DROP VIEW IF EXISTS {name}"))
    if inspect(connection).has_table(_DEFINITIONS.name):
        connection.execute(_DEFINITIONS.delete())


def _stored(connection: Connection) -> dict[str, str]:
    rows = connection.execute(select(_DEFINITIONS.c.name, _DEFINITIONS.c.sha256))
    return {row.name: row.sha256 for row in rows}


def _hash(query: str) -> str:
    return hashlib.sha256(query.encode()).hexdigest()
