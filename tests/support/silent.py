"""Progress without output."""

from collections.abc import Iterator
from contextlib import contextmanager

from pipelines.engine.progress import Advance


class Silent:
    """Progress that prints nothing."""

    @contextmanager
    def track(self, what: str, total: int) -> Iterator[Advance]:
        """Yield a function that does nothing."""
        yield lambda _step, _note: None
