"""All rows that a run has stored, in an order that does not depend on when they were written."""

from sqlalchemy import select

from db.models import Base
from pipelines.workspace.workspace import Workspace

# Keys that the database generates, and times: two equal runs differ in them.
CHANCE = {"id", "seconds", "created_at", "imported_at", "decided_at"}
# The input, not the result: it contains executor and paths.
SETTINGS = {"config"}


def dump(workspace: Workspace) -> list[tuple]:
    """Return every row of every table as (table, *values), floats to the last bit."""
    rows = []
    for table in Base.metadata.sorted_tables:
        columns = [column for column in table.columns if column.name not in CHANCE | SETTINGS]
        found = workspace.database.rows(select(*columns))
        rows += sorted(((table.name, *map(_exact, row)) for row in found), key=repr)
    return rows


def rows(workspace: Workspace, sql: str) -> list[tuple]:
    """Return the rows of a query."""
    with workspace.database.reading() as connection:
        return [tuple(row) for row in connection.exec_driver_sql(sql)]


def _exact(value: object) -> object:
    return value.hex() if isinstance(value, float) else value
