"""Views for people who query."""

from sqlalchemy import Connection, column, table, text

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS

# The view, to select from.
WEIGHTED_LABELS = table("weighted_labels", *map(column, WEIGHTED_LABEL_COLUMNS))

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
_PREDICTED = """
               p.k, p.category, p.x, p.y, p.z, p.length, p.width, p.height, p.yaw,
               p.score, c.loss, pp.points, pp.points_threshold, pp.rho_diff,
               sp.mask_pixels, sp.box_pixels, sp.rho_anno, w.rho_det, w.lambda_u
"""
_REAL, _INTEGER = "CAST(NULL AS DOUBLE PRECISION)", "CAST(NULL AS INTEGER)"

# What the policies say where nobody has decided, predictions that people rejected, and what they
# hold for objects. Decisions are few: SQLite, which keeps the order of a CROSS JOIN, walks through
# them first and looks their frames up one by one. A condition on frames alone, the split's for one,
# would make it read all frames into a Bloom filter before the first row, hence the CASE on a k.
# A server finds one frame's labels of all rounds by their key only where it is given the rounds.
_WEIGHTED_LABELS = f"""
        SELECT p.round, f.frame, {_PREDICTED}, 'detector' AS provenance, w.policy, w.v AS weight
        FROM round AS r
        JOIN weight AS w ON w.round = r.number
        JOIN prediction AS p ON p.round = w.round AND p.frame_id = w.frame_id AND p.k = w.k
        JOIN frame AS f ON f.id = w.frame_id
        {_EVIDENCE}
        WHERE CASE WHEN w.k >= 0 THEN f.split END = 'unlabeled' AND NOT EXISTS (
            SELECT 1 FROM human_match AS m
            WHERE m.round = w.round AND m.frame_id = w.frame_id AND m.k = w.k
        )
        UNION ALL
        SELECT p.round, (SELECT f.frame FROM frame AS f WHERE f.id = m.frame_id), {_PREDICTED},
               'human', w.policy, CAST(0.0 AS DOUBLE PRECISION)
        FROM human_match AS m CROSS JOIN human_label AS h CROSS JOIN weight AS w
        CROSS JOIN prediction AS p
        {_EVIDENCE}
        WHERE h.frame_id = m.frame_id AND h.n = m.n AND h.decision = 'rejected'
          AND w.round = m.round AND w.frame_id = m.frame_id AND w.k = m.k
          AND p.round = m.round AND p.frame_id = m.frame_id AND p.k = m.k
        UNION ALL
        SELECT r.number, (SELECT f.frame FROM frame AS f WHERE f.id = h.frame_id),
               CAST(COALESCE(m.k, 1000000 + h.n) AS INTEGER), h.category,
               h.x, h.y, h.z, h.length, h.width, h.height, h.yaw,
               CAST(1.0 AS DOUBLE PRECISION), {_REAL}, {_INTEGER}, {_REAL}, {_REAL},
               {_INTEGER}, {_INTEGER}, {_REAL}, {_REAL}, {_REAL},
               'human', t.variant, CAST(1.0 AS DOUBLE PRECISION)
        FROM human_label AS h CROSS JOIN round AS r CROSS JOIN task AS t
        LEFT JOIN human_match AS m
            ON m.round = r.number AND m.frame_id = h.frame_id AND m.n = h.n AND m.leads = 1
        WHERE h.decision <> 'rejected' AND r.number >= h.from_round
          AND t.round = r.number AND t.stage = 'solve' AND t.frame_id IS NULL
"""  # noqa: S608 - made of constants

_VIEWS = {
    "weighted_labels": _WEIGHTED_LABELS,
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


def create_views(connection: Connection) -> None:
    """Creates every view."""
    for name, query in _VIEWS.items():
        connection.execute(text(f"CREATE VIEW {name} AS {query}"))


def drop_views(connection: Connection) -> None:
    """Drops every view, so that the tables beneath can change."""
    for name in _VIEWS:
        connection.execute(text(f"DROP VIEW IF EXISTS {name}"))
