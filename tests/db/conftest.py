"""An empty database."""

from collections.abc import Callable
from pathlib import Path

import pytest

from db.session import Database


@pytest.fixture
def database(tmp_path: Path, new_url: Callable[[], str | None]) -> Database:
    """Return an empty database: SQLite, or each engine in modules with ENGINES."""
    return Database(new_url() or f"sqlite:///{tmp_path / 'curate.db'}")
