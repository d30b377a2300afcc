"""The minimum that predictions can refer to: an unlabeled frame and a round."""

from sqlalchemy import Connection

from support.stored_tuples import store


def add_one_frame(connection: Connection) -> None:
    """Insert both into an empty database, with key 1."""
    store(connection, "frame", [("kitti", "x", "unlabeled", "p", "i", "c", None)])
    store(connection, "round", [(1, 1, None, "{}", "0", 0)])
