"""A check of sample frames at the start: is the data set what it was declared to be?"""

import logging
from collections.abc import Sequence

from curate.datasets.base import Dataset
from curate.errors import DataError

_log = logging.getLogger(__name__)

_SAMPLES = 5


def check_samples(dataset: Dataset, frames: Sequence[str]) -> None:
    """Read the points and the calibration of some frames, evenly spread over the names.

    A wrong number of columns, a wrong scale of the intensities, or a calibration of another format
    affects every frame, so it shows in all of them. A single damaged frame is only logged: it will
    be recorded as failed and skipped.

    Args:
        dataset: the data set.
        frames: the names of its frames, sorted.

    Raises:
        DataError: if none of the sample frames can be read; the message is that of the first.
    """
    count = min(_SAMPLES, len(frames))
    samples = [frames[k * (len(frames) - 1) // max(count - 1, 1)] for k in range(count)]
    errors: dict[str, DataError] = {}
    for frame in samples:
        try:
            dataset.read(frame)
        except DataError as error:
            errors[frame] = error
    if errors and len(errors) == count:
        raise next(iter(errors.values()))
    for frame, problem in errors.items():
        _log.warning("frame %s cannot be read: %s", frame, problem)
