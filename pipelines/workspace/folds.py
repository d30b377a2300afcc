"""Held-out folds of X_l: small workspaces inside the workspace, each with its own database.

The teacher of a fold is trained on the other folds; the fold itself is its val split. If the data
set has sequences, a fold contains whole sequences. A fold keeps its results, so an interrupted
audit or calibration resumes, and both share the trained teachers.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from curate.datasets.base import sequences_of
from curate.errors import ConfigError, WorkspaceError
from curate.firewall.sequences import group_by_sequence
from pipelines.workspace.config import Config, read_config
from pipelines.workspace.config_file import write_config
from pipelines.workspace.location import CONFIG_NAME
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace, anchored


def open_folds(workspace: Workspace, folds: int, option: str = "--folds") -> Iterator[Workspace]:
    """Yield the workspace of every fold; a missing one is created.

    Args:
        workspace: the workspace.
        folds: number of folds.
        option: option or setting with this number, for messages.

    Raises:
        ConfigError: if there are fewer labeled frames, or sequences of labeled frames, than folds.
    """
    labeled = sorted(workspace.frames("labeled"))
    for root, held_out in zip(
        _folders(workspace, folds), split_folds(workspace, folds, option), strict=True
    ):
        root.mkdir(parents=True, exist_ok=True)
        rest = sorted(set(labeled) - set(held_out))
        lists = [
            _write_list(root / f"{split}.txt", names)
            for split, names in (("labeled", rest), ("val", held_out))
        ]
        config = _fold_config(workspace)
        if (root / CONFIG_NAME).exists() and read_config(root / CONFIG_NAME) != config:
            # The workspace's settings have changed; the results that depend on them become stale.
            write_config(root / CONFIG_NAME, config)
        yield initialise(root, config, *map(str, lists), compare=False)


def existing_folds(workspace: Workspace, folds: int) -> list[Workspace]:
    """Return the workspaces of the folds, with the current settings; nothing is written.

    Raises:
        WorkspaceError: if one does not exist yet.
    """
    config, found = _fold_config(workspace), []
    for root in _folders(workspace, folds):
        if not (root / CONFIG_NAME).exists():
            raise WorkspaceError(f"{root}: the fold does not exist yet")
        found.append(replace(Workspace.open(root), config=anchored(root, config)))
    return found


def _folders(workspace: Workspace, folds: int) -> list[Path]:
    name = f"{folds}-folds-seed-{workspace.config.run.seed}"
    parent = workspace.root / "reports" / "audit" / name
    return [parent / f"fold-{fold + 1}" for fold in range(folds)]


def split_folds(workspace: Workspace, folds: int, option: str = "--folds") -> list[list[str]]:
    """Return the held-out frames of each fold, of about the same number in each.

    Sequences are not split. Only if there are too few of them, and the configuration does not
    require splits by sequence, are frames assigned one by one.

    Raises:
        ConfigError: see `open_folds`.
    """
    labeled = sorted(workspace.frames("labeled"))
    if not 2 <= folds <= len(labeled):
        allowed = (
            f"allow 2 to {len(labeled)} folds" if len(labeled) > 1 else "are too few for folds"
        )
        raise ConfigError(f"{option} {folds}: {len(labeled)} labeled frames {allowed}")
    generator = np.random.default_rng([workspace.config.run.seed, folds])
    groups = group_by_sequence(sequences_of(workspace.dataset, labeled), labeled)
    if len(groups) < folds:
        if workspace.config.dataset.split_by == "sequence":
            raise ConfigError(
                f"{option} {folds}: the labeled frames are from only {len(groups)} sequences, and "
                "a sequence is not split; use fewer folds, or label frames of more sequences"
            )
        groups = {frame: [frame] for frame in labeled}
    split: list[list[str]] = [[] for _ in range(folds)]
    for name in generator.permutation(sorted(groups)).tolist():
        min(split, key=len).extend(groups[name])
    return [sorted(fold) for fold in split]


def _fold_config(workspace: Workspace) -> Config:
    """Return the workspace's settings with absolute paths and the default database."""
    config = workspace.config
    detector, segmenter = config.detector.path, config.segmenter.path
    changes = {
        "dataset": {"root": config.dataset.root.resolve()},
        "detector": {"path": detector and (workspace.root / detector).resolve()},
        "segmenter": {"path": segmenter and segmenter.resolve()},
        "run": {"database": None},
    }
    return config.model_copy(
        update={
            section: getattr(config, section).model_copy(update=values)
            for section, values in changes.items()
        }
    )


def _write_list(path: Path, names: Sequence[str]) -> Path:
    path.write_text("".join(f"{name}\n" for name in names))
    return path
