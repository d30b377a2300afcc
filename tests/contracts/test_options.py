"""Options of every registered class are checked by its signature, before it is created."""

import inspect
from typing import Any

import numpy as np
import pytest

from curate.option_values import describe_wrong_values
from pipelines import registry

REGISTRIES = [each for each in vars(registry).values() if isinstance(each, registry.Registry)]
CLASSES = [(each, name) for each in REGISTRIES for name in each.classes]
PLAIN = (bool, int, float, str)


@pytest.mark.parametrize(
    ("kind", "name"), CLASSES, ids=[f"{kind.kind}-{name}" for kind, name in CLASSES]
)
def test_a_plain_option_has_a_type_that_is_checked(kind: registry.Registry, name: str) -> None:
    """A list of tables is never a plain value; the default always is one of the valid values."""
    found = kind.load(name)
    plain = {
        each.name: each.default
        for each in inspect.signature(found).parameters.values()
        if isinstance(each.default, PLAIN)
    }
    assert describe_wrong_values(found, plain) == ""
    for option in plain:
        wrong = describe_wrong_values(found, {option: [{}]})
        assert wrong.startswith(option)
        assert " should " in wrong
    if "threads" in plain:
        assert describe_wrong_values(found, {"threads": 0}) == (
            "threads = 0 should be greater than or equal to 1"
        )


@pytest.mark.parametrize(
    ("segmenter", "options", "words"),
    [
        ("onnx", {"tiles": "x"}, 'tiles = "x" should be a valid integer'),
        ("onnx", {"tiles": True}, "tiles = true should be a valid integer"),
        ("onnx", {"channels": "middle"}, "channels = \"middle\" should be 'first' or 'last'"),
        ("onnx", {"classes": {"Car": [7, "x"]}}, 'classes.Car.1 = "x" should be a valid integer'),
        ("onnx", {"classes": 3}, "classes = 3 should be a table"),
        ("saved", {"colours": 3}, "colours = 3 should be a valid string or be a table"),
        ("saved", {"colours": {"a": 1}}, "colours.a = 1 should be a list"),
        ("degraded", {"blobs": -1}, "blobs = -1 should be greater than or equal to 0"),
        ("onnx", {"tiles": 0, "threads": 0}, "tiles = 0 should be .* 1; threads = 0 should be"),
    ],
)
def test_the_message_has_the_option_its_value_and_what_it_should_be(
    segmenter: str, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(registry.ConfigError, match=f"^segmenter '{segmenter}': option {words}"):
        registry.SEGMENTERS.check(segmenter, "", offered=("classes",), options=options)


class OfAUser:
    """A class with annotations that no value of a file has, and one that does not exist."""

    def __init__(
        self, array: np.ndarray, call: "Any", unknown, *sizes: int, **further: int
    ) -> None: ...


def of_a_user(size: "NoSuchType") -> None:  # noqa: F821
    """A function with an annotation that cannot be evaluated."""


def test_an_unusual_type_is_not_checked() -> None:
    """The user's class may take anything."""
    options = {"array": [1], "unknown": [], "more": 1}
    assert describe_wrong_values(OfAUser, options) == ""
    assert describe_wrong_values(of_a_user, {"size": 3}) == ""
    assert describe_wrong_values(OfAUser, {"more": "x"}) == 'more = "x" should be a valid integer'
