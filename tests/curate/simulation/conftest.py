"""A small simulated dataset, and handmade scenes."""

from pathlib import Path

import numpy as np
import pytest

from curate.simulation import simulate
from curate.simulation.actors import actor_mesh
from curate.simulation.materials import palette
from curate.simulation.population import Placement
from curate.simulation.rig import CameraRig
from curate.simulation.scene import Scene
from curate.simulation.street import Street

FRAMES, SEED = 8, 5


@pytest.fixture(scope="session")
def simulated(tmp_path_factory) -> Path:
    """Return eight frames, two of them for validation, simulated by one process."""
    root = tmp_path_factory.mktemp("simulated")
    simulate(root, FRAMES, SEED, workers=1)
    return root


@pytest.fixture
def rig() -> CameraRig:
    """Return a camera similar to KITTI's."""
    return CameraRig.draw(np.random.default_rng(0))


@pytest.fixture
def flat_street() -> Street:
    """Return a level, straight street."""
    return Street(0.0, 1, 3.5, 0.0, 0.0, 3.0, 5.0, None, 4.0, (0.0, 0.0), (0.0, 50.0, 0.0))


@pytest.fixture
def scene_of(flat_street):
    """Return a function that builds a scene of (kind, x, y, yaw) or (mesh, x, y, yaw)."""

    def make(*things) -> Scene:
        placements = []
        for thing, x, y, yaw in things:
            kind = thing if isinstance(thing, str) else "obstacle"
            mesh = actor_mesh(thing, 0) if isinstance(thing, str) else thing
            position = np.array([x, y, flat_street.to_lidar(x, y)[2]])
            placements.append(Placement(kind, mesh, position, yaw, np.ones(3), palette()))
        return Scene.assemble(flat_street, placements)

    return make
