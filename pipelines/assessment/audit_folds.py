"""Held-out folds of X_l: small workspaces inside the workspace, each with its own database.

The teacher of a fold is trained on the other folds; the fold itself is its val split. If the data
set has sequences, a fold contains whole sequences. A fold keeps its results, so an interrupted
audit resumes.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from curate.datasets.base import sequences_of
from curate.errors import ConfigError
from curate.firewall.sequences import group_by_sequence
from pipelines.workspace.config import Config, read_config
from pipelines.workspace.config_file import write_config
from pipelines.workspace.location import CONFIG_NAME
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace


def open_folds(workspace: Workspace, folds: int) -> Iterator[Workspace]:
    """Yield the workspace of every fold; a missing one is created.

    Raises:
        ConfigError: if there are fewer labeled frames, or sequences of labeled frames, than folds.
    """
    labeled = sorted(workspace.frames("labeled"))
    if not 2 <= folds <= len(labeled):
        raise ConfigError(
            f"--folds {folds}: {len(labeled)} labeled frames allow 2 to {len(labeled)} folds"
        )
    seed = workspace.config.run.seed
    frames_of_folds = _split_folds(workspace, labeled, folds, np.random.default_rng([seed, folds]))
    parent = workspace.root / "reports" / "audit" / f"{folds}-folds-seed-{seed}"
    for fold, held_out in enumerate(frames_of_folds):
        root = parent / f"fold-{fold + 1}"
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


def _split_folds(
    workspace: Workspace, labeled: Sequence[str], folds: int, generator: np.random.Generator
) -> list[list[str]]:
    """Split the labeled frames into folds of about the same size, without splitting sequences.

    Only if there are too few sequences, and the configuration does not require splits by sequence,
    are frames assigned one by one.
    """
    groups = group_by_sequence(sequences_of(workspace.dataset, labeled), labeled)
    if len(groups) < folds:
        if workspace.config.dataset.split_by == "sequence":
            raise ConfigError(
                f"--folds {folds}: the labeled frames are from only {len(groups)} sequences, and "
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
