"""From recorded results to weights at scale: speed, memory, and kills.

The frames are links to a few hundred clouds of 20,000 points, with 30 recorded boxes each, the same
of a mirrored copy, and a saved map. `CURATE_PROOF_SCENES` sets a smaller number of frames.
"""

import hashlib
import os
import time
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import func, select
from support.process_tree import peaks, start
from support.recorded_scenes import write_recorded_scenes
from support.stored_rows import CHANCE, SETTINGS

from db.models import Base
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

pytestmark = pytest.mark.slow

FRAMES = int(os.environ.get("CURATE_PROOF_SCENES", "100000"))
TEMPLATES, KILLS = 300, 10
COMMANDS = ("predict", "repredict", "score", "solve", "export")
# solve reads a round into arrays: 30 labels per frame with a few numbers each.
FLAT = ("predict", "repredict", "score", "export")


def new_workspace(data: Path, document: dict, root: Path) -> Workspace:
    """Return a workspace of one round on the frames of a folder."""
    config = make_config(
        {**document, "run": {"rounds": 1, "executor": "process", "workers": 2}}, "proof"
    )
    workspace = initialise(root, config, str(data / "labeled.txt"), "")
    workspace.database.close()
    return workspace


def measured(workspace: Workspace, frames: int) -> dict[str, tuple[int, int]]:
    """Run all commands; print their speed and return the peaks of parent and workers in KiB."""
    found, whole = {}, 0.0
    for command in COMMANDS:
        began, before = time.monotonic(), os.times()
        with start(command, "-w", workspace.root) as running:
            found[command] = peaks(running)
            assert running.wait() == 0, running.stderr.read()
        seconds, after = time.monotonic() - began, os.times()
        whole += seconds
        cpu = after.children_user + after.children_system
        cpu -= before.children_user + before.children_system
        print(  # noqa: T201
            f"{frames} frames, {command}: {seconds:.1f} s, {cpu:.1f} s of CPU time, "
            f"{frames / seconds:.0f} frames/s, peak {found[command][0] >> 10} MiB, "
            f"worker {found[command][1] >> 10} MiB"
        )
    print(f"{frames} frames, all: {whole:.1f} s, {frames / whole:.0f} frames/s")  # noqa: T201
    return found


def digests(workspace: Workspace) -> dict[str, tuple[int, int]]:
    """Return, per table, the number of rows and a sum of their hashes, in any order."""
    found = {}
    with workspace.database.reading() as connection:
        for table in Base.metadata.sorted_tables:
            columns = [each for each in table.columns if each.name not in CHANCE | SETTINGS]
            count = total = 0
            result = connection.execution_options(stream_results=True).execute(select(*columns))
            for rows in result.partitions(10_000):
                for row in rows:
                    digest = hashlib.blake2b(repr(tuple(row)).encode(), digest_size=8).digest()
                    total += int.from_bytes(digest)
                count += len(rows)
            found[table.name] = (count, total)
    workspace.database.close()
    return found


def killed_and_resumed(workspace: Workspace, seconds: float, generator: np.random.Generator) -> int:
    """Run all stages, kill the command ten times at random, and let it finish; count the kills."""
    kills = 0
    for _ in range(KILLS):
        with start("run", "-w", workspace.root) as running:
            end = time.monotonic() + generator.uniform(1, 1 + seconds / KILLS)
            while running.poll() is None and time.monotonic() < end:
                time.sleep(0.05)
            if running.poll() is None:
                running.kill()
                kills += 1
    with start("run", "-w", workspace.root) as last:
        assert last.wait() == 0, last.stderr.read()
    return kills


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peaks are read from /proc")
def test_recorded_results_become_weights_whatever_is_killed(tmp_path: Path) -> None:
    """Memory is flat, and a run that was killed ten times ends like an undisturbed one."""
    few = write_recorded_scenes(tmp_path / "few", FRAMES // 10, TEMPLATES)
    small = measured(new_workspace(tmp_path / "few", few, tmp_path / "small"), FRAMES // 10)
    document = write_recorded_scenes(tmp_path / "data", FRAMES, TEMPLATES)
    whole = new_workspace(tmp_path / "data", document, tmp_path / "whole")
    began = time.monotonic()
    large = measured(whole, FRAMES)
    seconds = time.monotonic() - began
    for command in FLAT:
        for one, other in zip(small[command], large[command], strict=True):
            assert other < 1.25 * one or one == 0, (command, small[command], large[command])
    killed = new_workspace(tmp_path / "data", document, tmp_path / "killed")
    kills = killed_and_resumed(killed, seconds, np.random.default_rng(0))
    print(f"{kills} kills")  # noqa: T201
    assert kills >= KILLS // 2
    expected, found = digests(whole), digests(killed)
    assert found == expected
    with whole.database.reading() as connection:
        weight = Base.metadata.tables["weight"].c
        counted = connection.execute(select(func.count(), func.sum(weight.v))).one()
    whole.database.close()
    assert counted[0] > 20 * FRAMES
    assert counted[1] > 0
