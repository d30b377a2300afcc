"""The least that predictions can belong to: an unlabeled frame and a round."""

from sqlalchemy import Connection

from support.stored_tuples import store


def add_one_frame(connection: Connection) -> None:
    """Into an empty database; both have the key 1."""
    store(connection, "frame", [("kitti", "x", "unlabeled", "p", "i", "c", None)])
    store(connection, "round", [(1, 1, None, "{}", "0", 0)])
