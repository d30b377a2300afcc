"""The evidence of a round, read from the database in columns."""

import numpy as np
from sqlalchemy import text
from support.rounds import run_stage

from db import bulk
from pipelines.labels import evidence
from pipelines.workspace.workspace import Workspace

ENGINES = ("sqlite", "postgresql")


def test_every_label_gets_its_own_evidence(workspace: Workspace) -> None:
    """Only requested frames are read; the value is NaN if a table has no row of a label."""
    for name in ("predict", "repredict", "points", "semantic"):
        run_stage(workspace, name)
    frames = list(workspace.frames("unlabeled").values())
    with workspace.database.writing() as connection:
        connection.execute(text("DELETE FROM point_prior WHERE k = 0"))
    keys, found = evidence.read_evidence(workspace, 1, frames[1:], boxes=True)
    assert set(keys.frame_id.tolist()) <= set(frames[1:])
    assert np.isnan(found.rho["rho_diff"][keys.k == 0]).all()
    columns = {
        ("prediction", "score"): found.score,
        ("prediction", "iou"): found.iou,
        ("prediction", "yaw"): found.boxes[:, 6],
        ("consistency", "loss"): found.loss,
        ("point_prior", "rho_diff"): found.rho["rho_diff"],
        ("semantic_prior", "rho_anno"): found.rho["rho_anno"],
    }
    with workspace.database.reading() as connection:
        label = bulk.table("prediction")
        query = label.select().where(label.c.frame_id.in_(frames[1:]))
        rows = [row[1:4] for row in bulk.select(connection, query)]
        assert sorted(rows) == list(
            zip(keys.frame_id.tolist(), keys.k.tolist(), keys.category.tolist(), strict=True)
        )
        for (table, column), values in columns.items():
            chosen = bulk.table(table).c
            stored = {
                (frame_id, k): value
                for frame_id, k, value in bulk.select(
                    connection,
                    bulk.table(table)
                    .select()
                    .with_only_columns(chosen.frame_id, chosen.k, chosen[column]),
                )
            }
            expected = [stored.get((frame_id, k)) for frame_id, k, _ in sorted(rows)]
            np.testing.assert_equal(values, np.array(expected, dtype=np.float64), err_msg=column)
