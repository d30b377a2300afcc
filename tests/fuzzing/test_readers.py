"""Every damaged file is read or gives a one-line error."""

import random
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fuzzing.targets import TARGETS, Target
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.process_tree import forget_peak, peak

# Few for each reader in the normal run; `make prove` tries many, `make fuzz` continues.
EXAMPLES, MANY = 60, 2_000
# Limits on the memory of many damaged files, after and during reading.
MOST_KIB = 300 << 10
# Readers in C that take long for a file, and were fuzzed more often by hand.
COSTLY = {
    "onnx detector": 15,
    "onnx segmenter": 15,
    "onnx instances": 15,
    "checkpoint": 15,
    "openpcdet checkpoint": 15,
    "configuration": 20,
}


def prepared(target: Target, folder: Path) -> tuple[Path, bytes]:
    """Return a valid file of a reader and its content."""
    path = folder / target.name
    target.write(path)
    return path, path.read_bytes()


@contextmanager
def within_memory() -> Iterator[None]:
    """Fail if reading a few bytes took far more memory than the readers themselves."""
    forget_peak()
    before = peak()
    yield
    assert peak() - before < MOST_KIB


def try_damaged(target: Target, path: Path, content: bytes) -> None:
    """Read damaged content; numerical overflow warnings are errors too."""
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        target.attempt(path)


@pytest.mark.parametrize("name", sorted(set(TARGETS) - {"checkpoint"}))
def test_a_valid_file_is_read(tmp_path: Path, name: str) -> None:
    """Otherwise the tests below would prove nothing."""
    path, _ = prepared(TARGETS[name], tmp_path)
    assert TARGETS[name].attempt(path) is None


@pytest.mark.parametrize("name", TARGETS)
def test_a_damaged_file_is_read_or_rejected(tmp_path_factory: pytest.TempPathFactory, name) -> None:
    """A result, or a CurateError of one line."""
    target = TARGETS[name]
    path, content = prepared(target, tmp_path_factory.mktemp("damaged"))

    @settings(
        max_examples=COSTLY.get(name, EXAMPLES),
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.randoms(use_true_random=False))
    def damage(chance: random.Random) -> None:
        try_damaged(target, path, target.damage(content, chance.randint))

    target.attempt(path)  # loads its libraries
    with within_memory():
        damage()


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_many_damaged_files_are_read_or_rejected(tmp_path: Path, name: str) -> None:
    """The same with more examples."""
    target = TARGETS[name]
    path, content = prepared(target, tmp_path)
    target.attempt(path)
    with within_memory():
        for seed in range(MANY):
            try_damaged(target, path, target.damage(content, random.Random(seed).randint))  # noqa: S311
