"""A Ray cluster of two nodes; one is killed while it works."""

import os
import signal
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from support.frame_functions import Slow
from support.process_tree import descendants, start
from support.rounds import run_workspace
from support.stored_rows import dump
from support.toys import toy_document, write_toy_kitti

from pipelines.engine.executors.base import FrameJob
from pipelines.engine.executors.ray import RayExecutor
from pipelines.workspace.config import make_config
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

pytestmark = pytest.mark.slow

DELAY_S = "0.3"


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Start a head on this machine, with room for one actor."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'")
    from ray.cluster_utils import Cluster

    for name, value in {"TOY_DELAY_S": DELAY_S, "RAY_worker_niceness": "0"}.items():
        monkeypatch.setenv(name, value)  # nodes pass it on to their actors
    try:
        made = Cluster(
            initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 100_000_000}
        )
    except Exception as error:  # noqa: BLE001 - Ray raises bare exceptions
        pytest.skip(f"no Ray cluster starts here: {error}")
    yield made
    made.shutdown()


def add_node(cluster: Any) -> Any:
    """Start a second node, with room for one actor."""
    return cluster.add_node(num_cpus=1, object_store_memory=100_000_000)


def kill_node(node: Any) -> None:
    """Send SIGKILL to every process of a node at once, its actors first."""
    own = [info.process.pid for infos in node.all_processes.values() for info in infos]
    for pid in [below for each in own for below in descendants(each)] + own:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def test_the_frame_of_a_killed_node_is_retried(cluster: Any, tmp_path: Path) -> None:
    """SIGKILL for all processes of the second node; every frame succeeds, one was started twice."""
    other = add_node(cluster)
    executor = RayExecutor(2, address=cluster.address)
    jobs = [FrameJob(key, f"{key:06d}") for key in range(60)]
    try:
        outcomes = executor.map(Slow(tmp_path, 0.5), jobs)
        found, nodes = [], set()
        for outcome in islice(outcomes, 40):
            found.append(outcome)
            nodes.add(outcome.rows[0]["nodes"]["name"][0])
            if len(nodes) == 2:
                break
        assert len(nodes) == 2, "both nodes work"
        kill_node(other)
        found += outcomes
    finally:
        executor.close()
    assert sorted(outcome.job.frame_id for outcome in found) == list(range(60))
    assert {outcome.error for outcome in found} == {None}
    begun = Counter(path.name.partition("-")[0] for path in tmp_path.iterdir())
    assert sorted(begun) == [job.frame for job in jobs]
    assert sum(begun.values()) <= 60 + 1


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """Return a toy dataset and its detector."""
    write_toy_kitti(tmp_path / "kitti", frames=48, val=2)
    (tmp_path / "detector.txt").write_text("")
    return tmp_path


def made(home: Path, name: str, **run: object) -> Workspace:
    """Create a workspace."""
    document = toy_document(home / "kitti", home / "detector.txt") | {"run": run}
    return initialise(home / name, make_config(document, "test"), "0.1", "")


def test_a_run_that_loses_a_node_stores_the_same_rows_as_a_serial_run(
    cluster: Any, home: Path
) -> None:
    """`curate run` with the address of a cluster; a node dies as soon as frames are stored."""
    other = add_node(cluster)
    options = {"ray": {"address": cluster.address}}
    workspace = made(home, "ray", executor="ray", workers=2, executor_options=options)
    running = start("run", "-w", workspace.root)
    while running.poll() is None and not _stored(workspace):
        time.sleep(0.1)
    kill_node(other)
    _, err = running.communicate()
    assert running.returncode == 0, err
    serial = made(home, "serial")
    run_workspace(serial)
    assert dump(workspace) == dump(serial)


def _stored(workspace: Workspace) -> int:
    """Return the number of finished frames."""
    with closing(sqlite3.connect(workspace.root / "curate.db")) as database:
        return database.execute("SELECT count(*) FROM task").fetchone()[0]
