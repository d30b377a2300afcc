"""Long walks in pieces that fit into memory, or into one question to a database."""

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")


def batched(items: Iterable[Item], size: int) -> Iterator[list[Item]]:
    """Yield the items, `size` at a time, in their order."""
    walk = iter(items)
    while batch := list(islice(walk, size)):
        yield batch
