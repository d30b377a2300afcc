"""The views of the database. `weighted_labels` follows from the declared evidence sources.

A view is recreated if the hash of its definition differs from the one in `view_definition`.
"""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import (
    Connection,
    Double,
    Integer,
    TableClause,
    Text,
    TextualSelect,
    bindparam,
    column,
    inspect,
    select,
    table,
    text,
)

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS
from db.evidence import Declaration, label_columns, read_declarations
from db.models import BOX_COLUMNS, Base, ViewDefinition, Weight

# The views with their core columns, for use in a FROM clause.
WEIGHTED_LABELS = table("weighted_labels", *map(column, WEIGHTED_LABEL_COLUMNS))
FAILED_FRAMES = table("failed_frames", *map(column, ("round", "stage", "frame", "split", "error")))
_DEFINITIONS = Base.metadata.tables[ViewDefinition.__tablename__]

# The evidence of a label joins by the key (round, frame_id, k) of its weight w.
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
_TYPES: Mapping[str, Any] = {
    "float64": Double(), "int32": Integer(), "int64": Integer(), "name": Text(),
}  # fmt: skip
_REAL, _INTEGER = _NULLS["float64"], _NULLS["int32"]


# The view is a union of three parts:
# 1. predictions without a human decision, with the weight of the policy;
# 2. predictions that a person rejected, with weight 0;
# 3. objects that a person accepted, moved or added, with weight 1.
# How the query planners determine the form of the query:
# - A condition of an outer query (WHERE weight > 0.9) is pushed down into the parts of the union,
#   and its ORDER BY uses an index, only if each part returns the column itself or an expression of
#   the same type. Hence the casts.
# - There are few human decisions. SQLite keeps the order of a CROSS JOIN, so parts 2 and 3 start
#   with the decisions and look up the frame of each.
# - A condition on frames alone, such as split = 'unlabeled', makes SQLite read all frames into a
#   Bloom filter before it returns the first row. The CASE, which contains w.k, prevents that.
# - PostgreSQL finds the labels of one frame in all rounds by their primary key only if it has the
#   round numbers. Hence the join with `round` in part 1.
def _weighted_labels(further: Sequence[Declaration]) -> str:
    """Return the query of the view, with the columns of further sources after the core ones."""
    stored, evidence = _stored(further)
    nulls = "".join(f", {_NULLS[column.kind]}" for each in further for column in each.columns)
    return f"""
        SELECT p.round, f.frame, {_PREDICTED}, 'detector' AS provenance, w.policy,
               w.v AS weight{stored}
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
               'human', w.policy, CAST(0.0 AS DOUBLE PRECISION){stored}
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
               'human', t.variant, CAST(1.0 AS DOUBLE PRECISION){nulls}
        FROM human_label AS h CROSS JOIN round AS r CROSS JOIN task AS t
        LEFT JOIN human_match AS m
            ON m.round = r.number AND m.frame_id = h.frame_id AND m.n = h.n AND m.leads = 1
        WHERE h.decision <> 'rejected' AND r.number >= h.from_round
          AND t.round = r.number AND t.stage = 'solve' AND t.frame_id IS NULL
"""  # noqa: S608 - composed of constants


def _stored(further: Sequence[Declaration]) -> tuple[str, str]:
    """Return the columns of further sources, and the joins of all evidence."""
    # The weight itself is joined already.
    aliases = {
        each: "w" if each.table == Weight.__tablename__ else f"s{i}"
        for i, each in enumerate(further)
    }
    columns = [(alias, column) for each, alias in aliases.items() for column in each.columns]
    return (
        "".join(f', {alias}."{column.name}"' for alias, column in columns),
        _EVIDENCE
        + "".join(
            _FURTHER.format(table=each.table, alias=each_alias)
            for each, each_alias in aliases.items()
            if each_alias != "w"
        ),
    )


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
"""For each view, the table column behind each of its columns, in the order of the view."""


def weighted_labels(connection: Connection) -> TableClause:
    """Return the view `weighted_labels` with all its columns, for use in a FROM clause."""
    names = (each.name for each in label_columns(read_declarations(connection)))
    return table("weighted_labels", *map(column, names))


def undecided_labels(connection: Connection, names: Sequence[str]) -> TextualSelect:
    """Return the query for the rows of `weighted_labels` of some frames without human decisions.

    It reads the tables behind part 1 of the view in the order of their key: half the time of the
    view, which sorts by the name of the frame and looks up a decision for each label. The order is
    that of the weights, the first table: SQLite would sort the rows by the k of another table.

    Args:
        connection: connection to the database.
        names: the columns of the view to read.

    Returns:
        A query with the parameters `round`, `policy` and `frames` (keys of unlabeled frames), for
        rows sorted by `frame.id` and k.
    """
    stored, evidence = _stored(read_declarations(connection))
    kinds = {column.name: column.kind for column in label_columns(read_declarations(connection))}
    query = text(f"""
        SELECT {", ".join(f'"{name}"' for name in names)} FROM (
            SELECT w.frame_id, w.k AS weight_k, p.round AS round, f.frame AS frame, {_PREDICTED},
                   'detector' AS provenance, w.policy AS policy, w.v AS weight{stored}
            FROM weight AS w CROSS JOIN prediction AS p CROSS JOIN frame AS f
            {evidence}
            WHERE w.round = :round AND w.policy = :policy AND w.frame_id IN :frames
              AND p.round = w.round AND p.frame_id = w.frame_id AND p.k = w.k
              AND f.id = w.frame_id
        ) AS labels ORDER BY frame_id, weight_k
    """)  # noqa: S608 - composed of constants and declared columns
    return query.bindparams(bindparam("frames", expanding=True)).columns(
        *(column(name, _TYPES[kinds[name]]) for name in names)
    )


def definitions(connection: Connection) -> Mapping[str, str]:
    """Return the defining query of each view by name."""
    return {"weighted_labels": _weighted_labels(read_declarations(connection)), **_VIEWS}


def refresh_views(connection: Connection) -> None:
    """Recreate all views if one of them differs from its current definition."""
    if not views_are_current(connection):
        drop_views(connection)
        create_views(connection)


def views_are_current(connection: Connection) -> bool:
    """Return whether all views in the database have their current definition."""
    current = {name: _hash(query) for name, query in definitions(connection).items()}
    return current == _recorded(connection)


def create_views(connection: Connection) -> None:
    """Create every view, and store the hash of its definition."""
    for name, query in definitions(connection).items():
        connection.execute(text(f"CREATE VIEW {name} AS {query}"))
        connection.execute(_DEFINITIONS.insert().values(name=name, sha256=_hash(query)))


def drop_views(connection: Connection) -> None:
    """Drop every view, so that the tables which they read can change."""
    for name in ("weighted_labels", *_VIEWS):
        connection.execute(text(f"DROP VIEW IF EXISTS {name}"))
    if inspect(connection).has_table(_DEFINITIONS.name):
        connection.execute(_DEFINITIONS.delete())


def _recorded(connection: Connection) -> dict[str, str]:
    rows = connection.execute(select(_DEFINITIONS.c.name, _DEFINITIONS.c.sha256))
    return {row.name: row.sha256 for row in rows}


def _hash(query: str) -> str:
    return hashlib.sha256(query.encode()).hexdigest()
