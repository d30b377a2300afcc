"""Parsing the URL of a database so that messages never show its password."""

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from curate.errors import ConfigError


def parse_url(address: str) -> URL:
    """Return the address as an SQLAlchemy URL.

    SQLAlchemy hides a password in its usual place, but not one in the query (`?password=...`).
    Such a password is moved to the usual place.

    Raises:
        ConfigError: if the address is not the URL of a database.
    """
    try:
        # No driver accepts a zero byte, and each reports it with a different error.
        url = make_url("" if "\0" in address else address)
    except ArgumentError as error:
        # The message does not repeat the address: it may contain a password.
        raise ConfigError(
            "run.database: not the URL of a database; write postgresql://USER@HOST/NAME, or leave "
            "it out to use curate.db in the workspace"
        ) from error
    if url.drivername in {"postgres", "postgresql"}:
        url = url.set(drivername="postgresql+psycopg")
    secret = url.query.get("password")
    if isinstance(secret, str):
        url = url.difference_update_query(["password"]).set(password=url.password or secret)
    return url
