"""Samples of registered extensions, and comparisons of their outputs."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

import numpy as np
import pytest

Sample = TypeVar("Sample")


def sample_of(samples: Mapping[str, Sample], name: str, description: str) -> Sample:
    """Return the sample of a registered extension; fail the test if there is none."""
    if name not in samples:
        pytest.fail(f"'{name}' is registered but has no sample: add to SAMPLES here {description}")
    return samples[name]


def assert_same(one: Any, other: Any) -> None:
    """Check that two dataclasses of arrays are equal to the last bit, types included."""
    for field in fields(one):
        a, b = np.asarray(getattr(one, field.name)), np.asarray(getattr(other, field.name))
        assert a.dtype == b.dtype, field.name
        np.testing.assert_array_equal(a, b, err_msg=field.name)


def assert_one_line(error: BaseException) -> None:
    """Check that a message fits on one line after `error:`."""
    assert str(error)
    assert "\n" not in str(error)
