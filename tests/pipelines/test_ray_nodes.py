"""A Ray cluster of two nodes, one of which is killed while it works."""

from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from frame_functions import Slow

from pipelines.executors.base import FrameJob
from pipelines.executors.ray import RayExecutor

pytestmark = pytest.mark.slow


@pytest.fixture
def cluster() -> Iterator[Any]:
    """A head on this machine, with room for one actor."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'")
    from ray.cluster_utils import Cluster

    try:
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    except Exception as error:  # noqa: BLE001 - Ray raises bare exceptions
        pytest.skip(f"no Ray cluster starts here: {error}")
    yield made
    made.shutdown()


def test_a_killed_node_costs_its_frame_a_retry_and_nothing_else(
    cluster: Any, tmp_path: Path
) -> None:
    """SIGKILL for all processes of the second node; every frame ends well, one was begun twice."""
    other = cluster.add_node(num_cpus=1)
    executor = RayExecutor(2, address=cluster.address)
    jobs = [FrameJob(key, f"{key:06d}") for key in range(60)]
    outcomes = executor.map(Slow(tmp_path, 0.5), jobs)
    found, nodes = [], set()
    for outcome in islice(outcomes, 40):
        found.append(outcome)
        nodes.add(outcome.rows["nodes"][0][0])
        if len(nodes) == 2:
            break
    assert len(nodes) == 2, "both nodes work"
    cluster.remove_node(other, allow_graceful=False)
    found += outcomes
    executor.close()
    assert sorted(outcome.job.frame_id for outcome in found) == list(range(60))
    assert {outcome.error for outcome in found} == {None}
    begun = Counter(path.name.partition("-")[0] for path in tmp_path.iterdir())
    assert sorted(begun) == [job.frame for job in jobs]
    assert sum(begun.values()) <= 60 + 1
