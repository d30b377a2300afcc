"""Shared test data: real KITTI frames if available, and small synthetic ones."""

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from sqlalchemy import Connection, Engine, event
from support import postgres_server, shapes  # noqa: F401 - before curate is imported
from support.exported import block, label, truth, truth_block
from support.paths import ROOT
from support.toys import write_toy_kitti

from curate.datasets.kitti.dataset import KittiDataset
from curate.detections import CATEGORIES
from curate.exporters.base import FrameFiles, LabelFileDescription, LabelSet
from curate.exporters.sqlite import SqliteExporter
from db.session import Database

# The default run tries the same examples every time; `make fuzz-all` and
# --hypothesis-profile=random try others.
# No deadline: on a busy machine the run time of an example says nothing.
settings.register_profile(
    "same", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("random", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("same")


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the tests out of the user's cache folder."""
    before = os.environ.get("XDG_CACHE_HOME")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))
    yield
    os.environ.pop("XDG_CACHE_HOME")
    if before is not None:
        os.environ["XDG_CACHE_HOME"] = before


_connected: set[Engine] = set()


@event.listens_for(Engine, "engine_connect")
def _remember(connection: Connection) -> None:
    _connected.add(connection.engine)


@pytest.fixture(autouse=True)
def _closed_databases() -> Iterator[None]:
    """Close each database that a test opened."""
    yield
    while _connected:
        _connected.pop().dispose()


def _shared(variable: str, name: str) -> Path:
    path = Path(os.environ.get(variable, ROOT.parent / "shared" / name))
    if not path.is_dir():
        pytest.skip(f"{variable} is not set and ../shared/{name} is not there")
    return path


@pytest.fixture(scope="session")
def kitti_root() -> Path:
    """Return the folder with real KITTI frames, recorded detections and a segmentation model."""
    return _shared("CURATE_KITTI", "kitti")


@pytest.fixture(scope="session")
def kitti_tracking_root() -> Path:
    """Return the folder with a real detector's results and the truth of real sequences."""
    return _shared("CURATE_KITTI_TRACKING", "kitti_tracking")


@pytest.fixture(scope="session")
def kitti_eval_root() -> Path:
    """Return synthetic labels and results, and the AP that the official devkit reports for them."""
    return _shared("CURATE_KITTI_EVAL", "kitti_eval")


@pytest.fixture(scope="session")
def openpcdet_oracle() -> Path:
    """Return OpenPCDet's own numbers for some of the real KITTI frames, with the checkpoints."""
    return _shared("CURATE_OPENPCDET_ORACLE", "openpcdet_oracle")


@pytest.fixture(scope="session")
def postgres() -> Iterator[postgres_server.PostgresServer]:
    """Return a PostgreSQL server with a migrated template; skip if PostgreSQL is not installed."""
    reason = postgres_server.unavailable()
    if reason is not None:
        pytest.skip(reason)
    with postgres_server.running_server() as server:
        server.execute(f"CREATE DATABASE {postgres_server.TEMPLATE}")
        Database(server.url(postgres_server.TEMPLATE)).close()
        yield server


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip the tests of wrong shapes if jaxtyping would reject those before our own checks do."""
    if config.getoption("--jaxtyping-packages"):
        reason = "gives arrays of wrong shapes on purpose"
        for item in items:
            if item.get_closest_marker("wrong_shapes"):
                item.add_marker(pytest.mark.skip(reason=reason))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run the tests of a module that defines ENGINES once per database engine."""
    engines = getattr(metafunc.module, "ENGINES", ())
    if engines and "engine" in metafunc.fixturenames:
        metafunc.parametrize("engine", engines, indirect=True)


@pytest.fixture
def engine(request: pytest.FixtureRequest) -> str:
    """Return the database engine: sqlite, unless the module defines ENGINES."""
    return getattr(request, "param", "sqlite")


@pytest.fixture
def new_url(engine: str, request: pytest.FixtureRequest) -> Callable[[], str | None]:
    """Return a function that gives each workspace a new database: a file, or one on the server."""
    if engine == "sqlite":
        return lambda: None
    server = request.getfixturevalue("postgres")
    return lambda: server.new_database(postgres_server.TEMPLATE)


@pytest.fixture
def toy_kitti(tmp_path: Path) -> Path:
    """Return twelve small frames in KITTI's layout, eight of them for training."""
    root = tmp_path / "kitti"
    write_toy_kitti(root, frames=12, val=4)
    return root


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a small preset, a tenth of the usual size, that covers the toy frames."""
    from curate.detectors.pillars import presets

    small = presets.PRESETS["small"]
    preset = replace(
        small,
        name="tiny",
        x_range=(0.0, 30.72),
        y_range=(-15.36, 15.36),
        pillar_channels=8,
        channels=(16, 16, 32),
        depths=(1, 1, 1),
        head_channels=16,
    )
    monkeypatch.setitem(presets.PRESETS, "tiny", preset)
    from curate.detectors.openpcdet import presets as anchor_presets

    voxel_rcnn = replace(
        anchor_presets.PRESETS["voxel-rcnn-small"],
        limits=(0, -16, -3, 32, 16, 1),
        voxel=(0.2, 0.2, 0.1),
        channels=(4, 4, 8, 8, 8, 8),
        layers=((1, 1, 8), (1, 2, 8)),
        upsampled=((2, 8), (4, 8)),
    )
    monkeypatch.setitem(anchor_presets.PRESETS, "tiny", voxel_rcnn)
    return "tiny"


@pytest.fixture
def make_labels(toy_kitti, tmp_path):
    """Return a function that writes a label file of `labeled` and `unlabeled` frames."""
    dataset = KittiDataset(toy_kitti)

    def make(
        labeled=4, unlabeled=0, weight=0.5, name="labels.sqlite", categories=CATEGORIES,
        zero_weight="ignore", provenance="detector",
    ) -> Path:  # fmt: skip
        ids = dataset.frame_ids()[: labeled + unlabeled]
        splits = dict.fromkeys(ids[:labeled], "labeled") | dict.fromkeys(ids[labeled:], "unlabeled")
        objects, labels = [], []
        for frame, split in splits.items():
            annotations = dataset.annotations(frame)
            for k, box in enumerate(annotations.boxes.tolist()):
                own = {"category": str(annotations.categories[k])}
                if split == "labeled":
                    objects.append(truth(frame, k, box, **own))
                else:
                    own |= {"weight": weight, "provenance": provenance}
                    labels.append(label(frame, k, box, **own))
        description = LabelFileDescription(
            "kitti", toy_kitti, categories, 1, "pspsl", "1", zero_weight
        )
        frames = [FrameFiles(frame, split, "p", "i", "c") for frame, split in splits.items()]
        given = LabelSet(
            description, frames, truth_block(objects), [block(labels)], dataset.read, dataset.read
        )
        SqliteExporter().write(tmp_path / name, given)
        return tmp_path / name

    return make
