"""A database with the schema of an older curate."""

from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection

import db


def downgrade(connection: Connection, revision: str) -> None:
    """Downgrade to a schema; the views must be dropped, or be those of that schema."""
    config = Config()
    config.set_main_option("script_location", str(Path(db.__file__).parent / "migrations"))
    config.attributes["connection"] = connection
    command.downgrade(config, revision)
