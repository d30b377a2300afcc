"""A database as an older curate has left it."""

from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection

import db


def downgrade(connection: Connection, revision: str) -> None:
    """Back to a schema; the views must be gone, or as they were then."""
    config = Config()
    config.set_main_option("script_location", str(Path(db.__file__).parent / "migrations"))
    config.attributes["connection"] = connection
    command.downgrade(config, revision)
