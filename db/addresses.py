"""The address of a database, as a URL whose password is not shown."""

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from curate.errors import ConfigError


def parse_url(address: str) -> URL:
    """Return an SQLAlchemy URL; a password in its query is moved to where it is not shown.

    Raises:
        ConfigError: if it is none.
    """
    try:
        # No driver takes a zero byte, and each says so with an error of its own.
        url = make_url("" if "\0" in address else address)
    except ArgumentError as error:
        # The text is not repeated: it may hold a password.
        raise ConfigError(
            "run.database: no URL of a database; write postgresql://USER@HOST/NAME, or leave it "
            "out for curate.db in the workspace"
        ) from error
    if url.drivername in {"postgres", "postgresql"}:
        url = url.set(drivername="postgresql+psycopg")
    secret = url.query.get("password")
    if isinstance(secret, str):  # where it stands otherwise, messages leave it out
        url = url.difference_update_query(["password"]).set(password=url.password or secret)
    return url
