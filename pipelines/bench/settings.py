"""What all cells of a bench have in common, and the configuration that follows from it."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from curate.errors import ConfigError, DataError, WorkspaceError
from curate.files.atomic import replace_file
from curate.spelling import did_you_mean
from pipelines.registry import trainable, trainable_names
from pipelines.stages.methods import METHODS, with_method
from pipelines.workspace.config import AtLeastOne, Config, Section, change_setting, make_config
from pipelines.workspace.config_errors import describe_errors

SYNTHETIC = "synthetic"
SETTINGS_FILE = "bench.json"
SIMULATION_FILE = "simulation.json"
# Settings that the grid itself decides, and the option that does.
OWN = {
    "dataset.kind": "--data",
    "dataset.root": "--data",
    "run.method": "--methods",
    "train.pretrain_steps": "--teacher-steps",
    "train.round_steps": "--steps",
    "train.threads": "--workers",
    "run.rounds": "--rounds",
    "run.seed": "--seeds",
    "run.executor": "--workers",
    "run.workers": "--workers",
    "run.database": "nothing: every cell keeps its own database",
}


class BenchSettings(Section):
    """What cells must share to be comparable; a bench's folder holds one of these.

    Attributes:
        data: "synthetic", or a folder in KITTI's layout.
        frames: training frames to simulate; None for a folder.
        val: validation frames to simulate; None for a folder.
        data_seed: of the simulation; None for a folder.
        steps: optimiser steps of every round.
        teacher_steps: of the teacher's training; None for as many.
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
        methods: names in `METHODS`.
        ratios: shares of the training frames that are labeled.
        seeds: of the draw of labeled frames, of training and of the augmented views.
    """

    methods: tuple[str, ...]
    ratios: tuple[float, ...]
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Bench:
    """A bench on disk.

    Attributes:
        root: its folder, absolute.
        settings: see `BenchSettings`.
        axes: the grid that was asked for last.
    """

    root: Path
    settings: BenchSettings
    axes: Axes

    @property
    def data(self) -> Path:
        """The data set."""
        return self.root / "data" if self.settings.data == SYNTHETIC else Path(self.settings.data)

    @property
    def simulated(self) -> bool:
        """Whether the truth of X_u is known because it was simulated."""
        return self.settings.data == SYNTHETIC or (self.data / SIMULATION_FILE).is_file()

    def config(self, seed: int, method: str | None = None) -> Config:
        """Return the settings of a cell's workspace; without a method, of what all methods share.

        Raises:
            ConfigError: if an override is wrong, or the method decides it.
        """
        overrides = _parsed(self.settings.overrides)
        document: dict[str, Any] = {
            "dataset": {"root": self.data},
            "segmenter": {"name": "simulated" if self.simulated else "none"},
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
                f"--set detector.name={shared.detector.name}: a bench trains its detector; use "
                f"one of {', '.join(trainable_names())}"
            )
        return shared if method is None else _under(shared, method, overrides)


def check_axes(axes: Axes) -> Axes:
    """Return the axes as they are.

    Raises:
        ConfigError: if an axis is empty or repeats itself, or a method or ratio does not exist.
    """
    for name, values in axes.model_dump().items():
        if not values or len(set(values)) < len(values):
            raise ConfigError(f"--{name} {','.join(map(str, values))}: give one or more, each once")
    unknown = [name for name in axes.methods if name not in METHODS]
    if unknown:
        meant = did_you_mean(unknown[0], METHODS)
        raise ConfigError(f"--methods {unknown[0]}: use some of {', '.join(METHODS)}{meant}")
    for ratio in axes.ratios:
        if not 0 < ratio <= 1:
            raise ConfigError(f"--ratios {ratio:g}: a share is above 0 and at most 1")
    if min(axes.seeds) < 0:
        raise ConfigError(f"--seeds {min(axes.seeds)}: must not be negative")
    return axes


def read_bench(root: Path) -> Bench | None:
    """Return the bench in a folder; None where there is none yet.

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
    """Mark the folder with the bench; a grid may grow, what its cells share may not change.

    Raises:
        WorkspaceError: if the folder holds a bench with other settings.
    """
    stored = read_bench(bench.root)
    if stored is not None and stored.settings != bench.settings:
        held, asked = stored.settings.model_dump(), bench.settings.model_dump()
        changed = [name for name in asked if held[name] != asked[name]]
        differences = ", ".join(
            f"{name.replace('_', '-')} {_shown(held[name])} instead of {_shown(asked[name])}"
            for name in changed
        )
        raise WorkspaceError(
            f"{bench.root}: holds a bench with {differences}; its cells could not be compared, "
            "choose another folder"
        )
    document = {
        "settings": bench.settings.model_dump(mode="json"),
        "grid": bench.axes.model_dump(mode="json"),
    }
    replace_file(bench.root / SETTINGS_FILE, (json.dumps(document, indent=1) + "\n").encode())


def _under(shared: Config, method: str, overrides: Mapping[str, Any]) -> Config:
    """Return the shared settings under a method, which must leave the overrides alone."""
    config = with_method(shared, method)
    before, after = shared.model_dump(), config.model_dump()
    for path in _paths(overrides):
        if _at(before, path) != _at(after, path):
            raise ConfigError(f"--set {'.'.join(path)}: method {method} decides that itself")
    return config


def _parsed(overrides: Sequence[str]) -> dict[str, Any]:
    """Return the overrides as a document."""
    document: dict[str, Any] = {}
    for override in overrides:
        key = override.partition("=")[0].strip()
        if key in OWN:
            raise ConfigError(f"--set {override}: decided by {OWN[key]}")
        change_setting(document, override)
    return document


def _merge(document: dict[str, Any], other: Mapping[str, Any]) -> None:
    """Put the other document's values into the first, table by table."""
    for key, value in other.items():
        if isinstance(value, dict) and isinstance(document.get(key), dict):
            _merge(document[key], value)
        else:
            document[key] = value


def _paths(document: Mapping[str, Any], of: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the paths of the document's values."""
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


def _shown(value: Any) -> str:
    return " ".join(value) or "none" if isinstance(value, tuple) else str(value)
