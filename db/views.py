"""Views for people who query."""

from sqlalchemy import Connection, column, table, text

from curate.exporters.base import WEIGHTED_LABEL_COLUMNS

# The view, to select from.
WEIGHTED_LABELS = table("weighted_labels", *map(column, WEIGHTED_LABEL_COLUMNS))

_VIEWS = {
    "weighted_labels": """
        SELECT p.round, f.frame, p.k, p.category,
               p.x, p.y, p.z, p.length, p.width, p.height, p.yaw,
               p.score, c.loss, pp.points, pp.points_threshold, pp.rho_diff,
               sp.mask_pixels, sp.box_pixels, sp.rho_anno, w.rho_det,
               w.lambda_u, CASE WHEN h.n IS NULL THEN 'detector' ELSE 'human' END AS provenance,
               w.policy, CASE WHEN h.n IS NULL THEN w.v ELSE 0.0 END AS weight
        FROM weight AS w
        JOIN prediction AS p ON p.round = w.round AND p.frame_id = w.frame_id AND p.k = w.k
        JOIN frame AS f ON f.id = w.frame_id
        LEFT JOIN consistency AS c
            ON c.round = w.round AND c.frame_id = w.frame_id AND c.k = w.k
        LEFT JOIN point_prior AS pp
            ON pp.round = w.round AND pp.frame_id = w.frame_id AND pp.k = w.k
        LEFT JOIN semantic_prior AS sp
            ON sp.round = w.round AND sp.frame_id = w.frame_id AND sp.k = w.k
        LEFT JOIN human_match AS m
            ON m.round = w.round AND m.frame_id = w.frame_id AND m.k = w.k
        LEFT JOIN human_label AS h ON h.frame_id = m.frame_id AND h.n = m.n
        WHERE f.split = 'unlabeled' AND (h.n IS NULL OR h.decision = 'rejected')
        UNION ALL
        SELECT t.round, f.frame, COALESCE(m.k, 1000000 + h.n), h.category,
               h.x, h.y, h.z, h.length, h.width, h.height, h.yaw,
               1.0, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, 'human', t.variant, 1.0
        FROM human_label AS h
        JOIN frame AS f ON f.id = +h.frame_id
        JOIN task AS t ON t.stage = 'solve' AND t.frame_id IS NULL AND t.round >= h.from_round
        LEFT JOIN human_match AS m
            ON m.round = t.round AND m.frame_id = h.frame_id AND m.n = h.n AND m.leads = 1
        WHERE h.decision <> 'rejected'
    """,
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
