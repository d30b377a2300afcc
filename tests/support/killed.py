"""Trainings that are killed halfway."""

from collections.abc import Callable


class Killed(Exception):  # noqa: N818 - stands for a signal
    """Ends a training halfway."""


def kill_at(last: int) -> Callable[[int, int, float], None]:
    """Return a progress callback that ends the training after a step."""

    def progress(step: int, steps: int, loss: float) -> None:
        if step == last:
            raise Killed

    return progress
