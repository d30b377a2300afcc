"""Memory does not grow with the number of frames."""

import os
from pathlib import Path

import pytest
from support.many_frames import write_many_frames
from support.process_tree import peaks, start

pytestmark = pytest.mark.slow

COMMANDS = ("predict", "repredict", "score")
# CURATE_PROOF_FRAMES sets a smaller number for shorter runs.
FEW, MANY = 1_000, int(os.environ.get("CURATE_PROOF_FRAMES", "100000"))


def peaks_of(home: Path, frames: int) -> dict[str, tuple[int, int]]:
    """Return the peak memory of every frame stage over recorded frames, two workers, in KiB."""
    csv = write_many_frames(home / "data", frames)
    init = start(
        "init", home / "work", "--root", home / "data", "--labeled", home / "data" / "labeled.txt",
        "--val", "0", "--detector", "recorded", "--detector-path", csv, "--segmenter", "none",
    )  # fmt: skip
    assert init.wait() == 0, init.stderr.read()
    return {command: _peaks(command, home / "work") for command in COMMANDS}


def _peaks(command: str, workspace: Path) -> tuple[int, int]:
    running = start(command, "-w", workspace, "--workers", 2)
    found = peaks(running)
    assert running.wait() == 0, running.stderr.read()
    print(f"{command}: {found[0]} KiB, each worker at most {found[1]} KiB")  # noqa: T201
    return found


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peaks are read from /proc")
def test_peak_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    """1,000 against 100,000 recorded frames: within 20 %, in the parent and in each worker."""
    few = peaks_of(tmp_path / "few", FEW)
    many = peaks_of(tmp_path / "many", MANY)
    for command in COMMANDS:
        for small, large in zip(few[command], many[command], strict=True):
            assert 0 < large < 1.2 * small, (command, few[command], many[command])
