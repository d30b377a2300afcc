"""A workspace with millions of synthetic labels, written by SQLite itself."""

import sqlite3
from contextlib import closing
from pathlib import Path

from curate.datasets.kitti.dataset import KittiDataset
from curate.frames import FrameFiles
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace
from support.toys import toy_document, write_toy_kitti

TOY_FRAMES = 12
PER_FRAME = 50

# Pseudo-random numbers in [0, 1], the same on every machine.
_DRAW = "(((f.id * 7919 + n.k * 104729 + {round} * 15485863 + {salt} * 32452843) % 9973) / 9973.0)"
_ROWS = "FROM frame AS f CROSS JOIN n WHERE f.id > 1000 AND f.id % {share} = 0 ORDER BY f.id, n.k"
_NUMBERS = (
    f"WITH RECURSIVE n(k) AS (SELECT 0 UNION ALL SELECT k + 1 FROM n WHERE k + 1 < {PER_FRAME}) "
)


# An index by value would cost a seek for each of the millions of inserted rows.
_INDICES = (
    "SELECT name, sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL "
    "AND tbl_name IN ('prediction', 'weight') ORDER BY name"
)
# Columns and values per table; u0 to u3 are random draws per label, place is its number over all
# rounds.
_VALUES = {
    "prediction": (
        "category, score, x, y, z, length, width, height, yaw",
        """CASE n.k % 3 WHEN 0 THEN 'Car' WHEN 1 THEN 'Pedestrian' ELSE 'Cyclist' END, {u0},
        5 + n.k + 0.3 * {u1}, 30 * {place} - 15, -0.8, 4, 1.8, 1.5, 0""",
    ),
    "consistency": (
        "loss, views, matched_views",
        "CASE WHEN {u1} < 0.8 THEN 10 * {u1} * {u2} END, 1, {u1} < 0.8",
    ),
    "point_prior": (
        "points, points_threshold, rho_diff",
        "CAST(100 * {u2} AS INTEGER), 50, min(1, 2 * {u2})",
    ),
    "semantic_prior": (
        "mask_pixels, box_pixels, rho_anno",
        "CAST(1000 * {u3} AS INTEGER), 1000, {u3}",
    ),
    "weight": (
        "policy, lambda_u, rho_det, v",
        "'pspsl', 5.0, {u3}, CASE WHEN {u1} < 0.8 THEN {u3} * {u0} ELSE 0 END",
    ),
}


class EndlessKitti(KittiDataset):
    """A dataset in which every frame shows the files of one of a few."""

    def files(self, frame_id: str) -> FrameFiles:
        """Return the files of the frame that stands for it."""
        return super().files(f"{int(frame_id) % TOY_FRAMES:06d}")


def large_workspace(folder: Path, labels: tuple[int, ...]) -> Workspace:
    """Return a workspace with a number of labels in each of its rounds, weighted by pspsl."""
    write_toy_kitti(folder / "kitti", frames=TOY_FRAMES, val=4)
    (folder / "detector.txt").write_text("")
    document = toy_document(folder / "kitti", folder / "detector.txt")
    document["dataset"]["kind"] = "support.large_workspace:EndlessKitti"
    workspace = initialise(folder / "work", make_config(document, "test"), "0.25", "")
    workspace.database.close()
    with closing(sqlite3.connect(workspace.root / "curate.db")) as connection:
        connection.executescript(
            "PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF; PRAGMA cache_size = -200000;BEGIN"
        )
        indices = connection.execute(_INDICES).fetchall()
        for name, _ in indices:
            connection.execute(f"DROP INDEX {name}")
        frames = max(labels) // PER_FRAME
        _add_frames(connection, frames)
        for number, count in enumerate(labels, start=1):
            _add_round(connection, number, len(labels), max(frames * PER_FRAME // count, 1))
        for _, made in indices:
            connection.execute(made)
        # solve updates the statistics too; without them the planner scans all weights.
        connection.executescript("PRAGMA analysis_limit = 400; ANALYZE")
    return workspace


def _add_frames(connection: sqlite3.Connection, count: int) -> None:
    connection.execute(
        "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n WHERE i < ?) "
        "INSERT INTO frame (id, dataset, frame, split, points_path, image_path, calibration_path) "
        "SELECT 1000 + i, (SELECT dataset FROM frame LIMIT 1), printf('%06d', 1000 + i), "
        "'unlabeled', '', '', '' FROM n",
        (count,),
    )


def _add_round(connection: sqlite3.Connection, number: int, rounds: int, share: int) -> None:
    """Insert the rows of a round for every `share`-th frame."""
    connection.execute(
        "INSERT INTO round (number, rounds, config, code_version, seed) VALUES (?, ?, '{}', '', 0)",
        (number, rounds),
    )
    draw = {f"u{salt}": _DRAW.format(round=number, salt=salt) for salt in range(4)}
    draw["place"] = _DRAW.format(round=0, salt=9)
    for table, values in _VALUES.items():
        columns, chosen = values
        connection.execute(
            f"INSERT INTO {table} (round, frame_id, k, {columns}) {_NUMBERS} "
            f"SELECT {number}, f.id, n.k, {chosen.format(**draw)} {_ROWS.format(share=share)}"
        )
