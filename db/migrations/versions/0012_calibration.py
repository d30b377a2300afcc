"""The split of frames for calibration, and the fit that turns evidence into probabilities."""

import re
from collections.abc import Mapping

import sqlalchemy as sa
from alembic import op

from db.ddl import deleted_with, integer, prediction_key, real, table, text

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

_COMMENT = "labeled | unlabeled | val"
# Of each table: the name of the constraint, the splits before this revision and after it.
_SPLITS = {
    "frame": ("split", ("labeled", "unlabeled", "val")),
    "ground_truth": ("never_unlabeled", ("labeled", "val")),
}


def upgrade() -> None:
    """Upgrade the schema."""
    _change_splits(
        {name: (splits, (*splits, "calibration")) for name, (_, splits) in _SPLITS.items()}
    )
    _comment(f"{_COMMENT} | calibration")
    table(
        "calibration",
        integer("round", primary_key=True, refers="round.number"),
        text("source", "calibration | folds"),
        integer("folds", "0 = frames set aside"),
        text("overlap", "bev | 3d"),
        text("thresholds", "kitti | relaxed"),
        text("teacher", "hash of the checkpoint, '' for a command without one"),
        integer("frames", "with ground truth"),
        integer("labels", "that are right or wrong"),
        integer("neutral", "further labels that are neither"),
        integer("right_labels"),
        real("auroc", "out of sample", nullable=True),
        real("calibration_error", "out of sample", nullable=True),
        text("fit", "JSON; null = too few labels", nullable=True),
        text("fallback", "why there is no fit; null = there is one", nullable=True),
        text("unit", "frame | sequence"),
        integer("held_out_frames", "for max_wrong; 0 = none"),
    )
    table(
        "calibration_label",
        *prediction_key(),
        real("probability", "0 to 1"),
        integer("correct", "1 = right, 0 = wrong, null = neither", nullable=True),
        text("unit", "the sequence, or the frame"),
        deleted_with("prediction", "round", "frame_id", "k"),
    )
    op.add_column(
        "weight",
        real("probability", "that the label is right; null = not estimated", nullable=True),
    )


def downgrade() -> None:
    """Downgrade the schema; there must be no frame for calibration."""
    op.drop_column("weight", "probability")
    op.drop_table("calibration_label")
    op.drop_table("calibration")
    _comment(_COMMENT)
    _change_splits(
        {name: ((*splits, "calibration"), splits) for name, (_, splits) in _SPLITS.items()}
    )


def _comment(comment: str) -> None:
    """Change the comment of frame.split, where the database stores comments."""
    if op.get_bind().dialect.name == "postgresql":
        op.alter_column("frame", "split", comment=comment)


def _change_splits(changes: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]) -> None:
    """Replace the constraints on the splits.

    SQLite can change a constraint only by copying the table. The copy gets the name of the table
    while foreign keys are off, so that the tables which refer to it stay as they are.
    """
    if op.get_bind().dialect.name == "sqlite":
        # Without this setting, a rename checks the views and triggers that read the dropped table.
        op.execute("PRAGMA legacy_alter_table = ON")
        for name, (before, after) in changes.items():
            _copy_table(name, _list(before), _list(after))
        op.execute("PRAGMA legacy_alter_table = OFF")
        return
    for name, (_, after) in changes.items():
        constraint = f'"ck_{name}_{_SPLITS[name][0]}"'
        op.execute(f"ALTER TABLE {name} DROP CONSTRAINT {constraint}")
        op.execute(
            f"ALTER TABLE {name} ADD CONSTRAINT {constraint} CHECK (split IN ({_list(after)}))"
        )


def _copy_table(name: str, before: str, after: str) -> None:
    """Copy a table, with its indexes and triggers, to change a part of its definition."""
    connection = op.get_bind()
    query = sa.text("SELECT type, sql FROM sqlite_master WHERE tbl_name = :name AND sql > ''")
    parts = connection.execute(query, {"name": name}).all()
    [definition] = [sql for kind, sql in parts if kind == "table"]
    copy = re.sub(rf'^CREATE TABLE "?{name}"?', f"CREATE TABLE {name}_copy", definition)
    connection.exec_driver_sql(copy.replace(before, after))
    op.execute(f"INSERT INTO {name}_copy SELECT * FROM {name}")  # noqa: S608
    op.execute(f"DROP TABLE {name}")
    op.execute(f"ALTER TABLE {name}_copy RENAME TO {name}")
    for kind, sql in parts:
        if kind != "table":
            connection.exec_driver_sql(sql)


def _list(splits: tuple[str, ...]) -> str:
    return ", ".join(f"'{split}'" for split in splits)
