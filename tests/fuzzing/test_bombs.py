"""Memory stays bounded whatever a file claims."""

import subprocess
import sys
from pathlib import Path

from fuzzing.bombs import BOMBS
from fuzzing.targets import TARGETS
from support.paths import TESTS
from support.process_tree import forget_peak, peak

# In addition to the memory of Python and its libraries.
MOST_KIB = 300 << 10


def test_every_bomb_is_rejected_and_none_fills_the_memory(tmp_path: Path) -> None:
    """All in one process; its peak memory is compared."""
    ended = subprocess.run(
        [sys.executable, "-m", "fuzzing.test_bombs", tmp_path],
        capture_output=True,
        text=True,
        cwd=TESTS,
        env={"PYTHONPATH": f"{TESTS}:{TESTS.parent}", "PATH": "", "OMP_NUM_THREADS": "1"},
        check=False,
        timeout=300,
    )
    assert ended.returncode == 0, ended.stderr[-2000:]
    grown = dict(line.rsplit(": ", 1) for line in ended.stdout.splitlines())
    assert set(grown) == set(BOMBS)
    assert {name: int(size) for name, size in grown.items() if int(size) > MOST_KIB} == {}


def explode(folder: Path) -> None:
    """Read every bomb, and print by how many KiB the peak memory of this process grew."""
    for name, (kind, write) in BOMBS.items():
        target = TARGETS[kind]
        # A valid file first, so that the libraries are loaded before the measurement.
        home = folder / name.replace(" ", "-")
        for use in (target.write, write):
            home.mkdir()
            use(home / target.name)
            forget_peak()
            before = peak()
            rejected = target.attempt(home / target.name)
            home.rename(folder / f"{home.name}-{use is write}")
        grown = peak() - before
        assert rejected is not None, name
        sys.stdout.write(f"{name}: {grown}\n")


if __name__ == "__main__":
    explode(Path(sys.argv[1]))
