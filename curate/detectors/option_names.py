"""Names of the options for reading results, in messages of `RecordedDetector` and its checks.

They name `detector.options.KEY`. The detector `command` has these options in a table of their own:
`detector.options.results.KEY`.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager

from curate.errors import CurateError

_OPTION = re.compile(r"detector\.options\.(?!results|command|files)")


def name_results_options(message: str) -> str:
    """Return a message with the options named as the detector `command` has them."""
    return _OPTION.sub("detector.options.results.", message)


@contextmanager
def results_options_named() -> Iterator[None]:
    """Name the options in an error as the detector `command` has them."""
    try:
        yield
    except CurateError as error:
        raise type(error)(name_results_options(str(error))) from error
