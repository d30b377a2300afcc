"""Progress that shows nothing."""

from collections.abc import Iterator
from contextlib import contextmanager

from pipelines.engine.progress import Advance


class Silent:
    """Shows nothing."""

    @contextmanager
    def track(self, what: str, total: int) -> Iterator[Advance]:
        """Yields a function that does nothing."""
        yield lambda _step, _note: None
