"""The common settings of all cells of a bench, and the configuration of each cell."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from curate.errors import ConfigError, DataError, WorkspaceError
from curate.files.atomic import replace_file
from curate.ranges import AtLeastOne
from curate.spelling import did_you_mean
from pipelines.bench.truth import BENCH_METHODS, TRUTH
from pipelines.registry import trainable, trainable_names
from pipelines.stages.methods import with_method
from pipelines.workspace.config import Config, Section, change_setting, make_config
from pipelines.workspace.config_errors import describe_errors

SYNTHETIC = "synthetic"
SETTINGS_FILE = "bench.json"
SIMULATION_FILE = "simulation.json"
# Settings that overrides may not change, and the option that sets them.
FIXED = {
    "dataset.kind": "--data",
    "dataset.root": "--data",
    "run.method": "--methods",
    "train.pretrain_steps": "--teacher-steps",
    "train.round_steps": "--steps",
    "train.processes": "--workers",
    "train.threads": "--workers",
    "run.rounds": "--rounds",
    "run.seed": "--seeds",
    "run.executor": "--workers",
    "run.workers": "--workers",
    "run.database": None,
}


class BenchSettings(Section):
    """The settings that all cells of a bench share, because cells must be comparable.

    Attributes:
        data: "synthetic", or a folder in KITTI's layout.
        frames: number of training frames to simulate; None for a folder.
        val: number of validation frames to simulate; None for a folder.
        data_seed: seed of the simulation; None for a folder.
        steps: optimiser steps of every round.
        teacher_steps: optimiser steps of the teacher's training; None for the same number.
        rounds: E.
        overrides: "section.key=value", for every method.
    """

    data: str = SYNTHETIC
    frames: AtLeastOne | None = None
    val: AtLeastOne | None = None
    data_seed: int | None = None
    steps: AtLeastOne = 1200
    teacher_steps: AtLeastOne | None = None
    rounds: AtLeastOne = 2
    overrides: tuple[str, ...] = ()


class Axes(Section):
    """The grid: every method on every draw of labeled frames.

    Attributes:
        methods: names in `BENCH_METHODS`.
        ratios: shares of the training frames that are labeled.
        seeds: seeds of the draw of labeled frames, of training and of the augmented views.
    """

    methods: tuple[str, ...]
    ratios: tuple[float, ...]
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Bench:
    """A bench on disk.

    Attributes:
        root: absolute path of its folder.
        settings: see `BenchSettings`.
        axes: the grid of the last run.
    """

    root: Path
    settings: BenchSettings
    axes: Axes

    @property
    def data(self) -> Path:
        """The folder of the data set."""
        return self.root / "data" if self.settings.data == SYNTHETIC else Path(self.settings.data)

    @property
    def simulated(self) -> bool:
        """Whether the data is simulated, so that the ground truth of X_u is known."""
        return self.settings.data == SYNTHETIC or (self.data / SIMULATION_FILE).is_file()

    def config(self, seed: int, method: str | None = None) -> Config:
        """Return the configuration of a cell; without a method, of the shared job.

        Raises:
            ConfigError: if an override is invalid, or the method sets the same setting.
        """
        overrides = _parsed(self.settings.overrides)
        document: dict[str, Any] = {
            "dataset": {"root": self.data},
            "segmenter": {
                "name": "simulated" if self.simulated else "none",
                "cache": self.root / "maps",
            },
            "train": {
                "pretrain_steps": self.settings.teacher_steps or self.settings.steps,
                "round_steps": self.settings.steps,
            },
            "run": {"rounds": self.settings.rounds, "seed": seed},
        }
        _merge(document, overrides)
        if document["segmenter"]["name"] == "none":
            document["run"].setdefault("priors", ("points",))
        shared = make_config(document, "curate bench")
        if trainable(shared.detector.name) is None:
            raise ConfigError(
                f"--set detector.name={shared.detector.name}: a bench needs a detector that it can "
                f"train; use one of {', '.join(trainable_names())}"
            )
        if method == TRUTH and not self.simulated:
            raise ConfigError(f"--methods {TRUTH}: only simulated data have the truth of X_u")
        return shared if method is None else _under(shared, method, overrides)


def check_axes(axes: Axes) -> Axes:
    """Check the axes and return them unchanged.

    Raises:
        ConfigError: if an axis is empty or has duplicates, or a method, ratio or seed is invalid.
    """
    for name, values in axes.model_dump().items():
        if not values or len(set(values)) < len(values):
            raise ConfigError(
                f"--{name} {','.join(map(str, values))}: give one or more values without duplicates"
            )
    unknown = [name for name in axes.methods if name not in BENCH_METHODS]
    if unknown:
        meant = did_you_mean(unknown[0], BENCH_METHODS)
        raise ConfigError(
            f"--methods {unknown[0]}: unknown method; choose from {', '.join(BENCH_METHODS)}{meant}"
        )
    for ratio in axes.ratios:
        if not 0 < ratio <= 1:
            raise ConfigError(f"--ratios {ratio:g}: must be above 0 and at most 1")
    if min(axes.seeds) < 0:
        raise ConfigError(f"--seeds {min(axes.seeds)}: must not be negative")
    return axes


def read_bench(root: Path) -> Bench | None:
    """Return the bench in a folder; None if there is none yet.

    Raises:
        DataError: if its settings are damaged.
    """
    root = root.resolve()
    path = root / SETTINGS_FILE
    if not path.is_file():
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        settings = BenchSettings.model_validate(document["settings"])
        return Bench(root, settings, Axes.model_validate(document["grid"]))
    except (ValueError, KeyError, TypeError) as error:
        reason = (
            describe_errors(error, Axes if error.title == "Axes" else BenchSettings)
            if isinstance(error, ValidationError)
            else error
        )
        raise DataError(f"{path}: is damaged ({reason}); restore it or delete it") from error


def claim(bench: Bench) -> None:
    """Write the settings of the bench into its folder.

    The grid may change later, but not the settings, because all cells must be comparable.

    Raises:
        WorkspaceError: if the folder contains a bench with other settings.
    """
    stored = read_bench(bench.root)
    if stored is not None and stored.settings != bench.settings:
        before, requested = stored.settings.model_dump(), bench.settings.model_dump()
        changed = [name for name in requested if before[name] != requested[name]]
        differences = ", ".join(
            f"{name.replace('_', '-')} {_as_text(before[name])} instead of "
            f"{_as_text(requested[name])}"
            for name in changed
        )
        raise WorkspaceError(
            f"{bench.root}: contains a bench with {differences}; its cells would not be "
            "comparable: choose another folder"
        )
    document = {
        "settings": bench.settings.model_dump(mode="json"),
        "grid": bench.axes.model_dump(mode="json"),
    }
    replace_file(bench.root / SETTINGS_FILE, (json.dumps(document, indent=1) + "\n").encode())


def _under(shared: Config, method: str, overrides: Mapping[str, Any]) -> Config:
    """Return the configuration of a method; it may not change settings of the overrides."""
    config = with_method(shared, BENCH_METHODS[method].policy)
    before, after = shared.model_dump(), config.model_dump()
    for path in _paths(overrides):
        if _at(before, path) != _at(after, path):
            raise ConfigError(f"--set {'.'.join(path)}: the method {method} sets this itself")
    return config


def _parsed(overrides: Sequence[str]) -> dict[str, Any]:
    """Parse the overrides into a configuration document."""
    document: dict[str, Any] = {}
    for override in overrides:
        key = override.partition("=")[0].strip()
        if key in FIXED:
            option = FIXED[key]
            reason = f"use {option}" if option else "every cell has its own database"
            raise ConfigError(f"--set {override}: cannot be set for a bench; {reason}")
        change_setting(document, override)
    return document


def _merge(document: dict[str, Any], other: Mapping[str, Any]) -> None:
    """Update a document with the values of another one, table by table."""
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(document.get(key), dict):
            _merge(document[key], value)
        else:
            document[key] = value


def _paths(document: Mapping[str, Any], of: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the path of every value in a document."""
    for key, value in document.items():
        if isinstance(value, dict):
            yield from _paths(value, (*of, key))
        else:
            yield (*of, key)


def _at(document: Mapping[str, Any], path: Sequence[str]) -> Any:
    value: Any = document
    for name in path:
        value = value[name]
    return value


def _as_text(value: Any) -> str:
    return " ".join(value) or "none" if isinstance(value, tuple) else str(value)
