"""What a run has stored; all of it in an order that does not depend on when it was written."""

from sqlalchemy import select

from db.models import Base
from pipelines.workspace.workspace import Workspace

# Keys that the database draws, and times: two equal runs differ in them.
CHANCE = {"id", "seconds", "created_at", "imported_at", "decided_at"}
# What was asked for, not what came out: it names executor and paths.
SETTINGS = {"config"}


def dump(workspace: Workspace) -> list[tuple]:
    """Every row of every table as (table, *values), floats to the last bit."""
    rows = []
    for table in Base.metadata.sorted_tables:
        columns = [column for column in table.columns if column.name not in CHANCE | SETTINGS]
        found = workspace.database.rows(select(*columns))
        rows += sorted(((table.name, *map(_exact, row)) for row in found), key=repr)
    return rows


def rows(workspace: Workspace, sql: str) -> list[tuple]:
    """The answer to a question."""
    with workspace.database.reading() as connection:
        return [tuple(row) for row in connection.exec_driver_sql(sql)]


def _exact(value: object) -> object:
    return value.hex() if isinstance(value, float) else value
