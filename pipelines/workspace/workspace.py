"""A workspace: the folder with the configuration, the database and the results of a project."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import select

from curate.category_names import renamed
from curate.datasets.base import Dataset
from curate.datasets.formats.point_layout import PointLayout
from curate.datasets.frame_names import FrameNames
from curate.datasets.kitti.labels import DONT_CARE
from curate.detections import Annotations, Detections
from curate.errors import ConfigError, WorkspaceError
from db import bulk
from db.models import BOX_COLUMNS, RECTANGLE_COLUMNS
from db.session import Database
from pipelines import registry
from pipelines.workspace.config import Config, make_config, read_config
from pipelines.workspace.config_file import write_config, write_schema
from pipelines.workspace.location import CONFIG_NAME, find_workspace, url_of

_LAYOUT_SETTINGS = tuple(field.name for field in fields(PointLayout))


@dataclass(frozen=True)
class Workspace:
    """An open workspace.

    Attributes:
        root: its folder, absolute.
        config: the settings of `curate.toml`, with the options of the command line applied.
        database: its database.
        allow_empty: whether an export may lose all labels of a category (`--allow-empty`).
    """

    root: Path
    config: Config
    database: Database
    allow_empty: bool = False

    @classmethod
    def open(cls, folder: Path | None = None) -> "Workspace":
        """Return the workspace in `folder`, or else the nearest one at or above the current folder.

        Raises:
            WorkspaceError: if there is none.
            ConfigError: if its configuration is invalid.
        """
        root = find_workspace(folder)
        config = anchored(root, read_config(root / CONFIG_NAME))
        return cls(root, config, Database(url_of(root, config), root))

    @classmethod
    def create(cls, root: Path, config: Config) -> "Workspace":
        """Create a workspace with an empty database, or open one with the same settings.

        Raises:
            WorkspaceError: if the folder is a workspace with other settings.
        """
        root = root.resolve()
        path = root / CONFIG_NAME
        if path.exists() and read_config(path) != config:
            raise WorkspaceError(f"{path}: has other settings; edit it, or choose another folder")
        for folder in ("checkpoints", "exports", "pictures", "reports"):
            (root / folder).mkdir(parents=True, exist_ok=True)
        if path.exists():
            write_schema(root)
        else:
            write_config(path, config)
        config = anchored(root, config)
        return cls(root, config, Database(url_of(root, config), root))

    def with_settings(self, section: str, **changes: Any) -> "Workspace":
        """Return the same workspace with other settings in a section, for this command only.

        Raises:
            ConfigError: if a setting is invalid.
        """
        changed = {**dict(getattr(self.config, section)), **changes}
        config = make_config({**dict(self.config), section: changed}, "command line")
        return replace(self, config=config)

    @cached_property
    def dataset(self) -> Dataset:
        """The data set."""
        return open_dataset(self.config)

    def relative(self, path: Path) -> str:
        """Return a path as it is stored: relative inside the workspace, so that it can be moved."""
        path = path.resolve()
        return str(path.relative_to(self.root) if path.is_relative_to(self.root) else path)

    def frames(self, *splits: str) -> dict[str, int]:
        """Return frame names with their keys, ordered by name."""
        frame = bulk.table("frame")
        query = select(frame.c.frame, frame.c.id).where(frame.c.split.in_(splits))
        return dict(self.database.rows(query.order_by(frame.c.frame)))

    def frame_names(self, *splits: str) -> FrameNames:
        """Return the frames of some splits, found by any spelling."""
        return FrameNames(self.frames(*splits))

    def ground_truth(self, *splits: str) -> dict[str, Annotations]:
        """Return the stored ground truth by frame name; unlabeled frames have none."""
        truth, frame = bulk.table("ground_truth"), bulk.table("frame")
        names = ("category", *BOX_COLUMNS, "truncated", "occluded", "alpha", *RECTANGLE_COLUMNS)
        query = (
            select(frame.c.frame, *(truth.c[name] for name in names))
            .join(frame, frame.c.id == truth.c.frame_id)
            .where(frame.c.split.in_(splits))
            .order_by(frame.c.frame, truth.c.k)
        )
        found = bulk.grouped(self.database.rows(query), self.frames(*splits))
        return {name: _annotations(rows) for name, rows in found.items()}

    def predictions(self, round_number: int, frame_ids: Sequence[int]) -> dict[int, Detections]:
        """Return the stored predictions of some frames, by frame key, in the order of k."""
        table = bulk.table("prediction")
        query = (
            select(
                table.c.frame_id,
                table.c.category,
                table.c.score,
                *(table.c[name] for name in (*BOX_COLUMNS, "iou")),
            )
            .where(table.c.round == round_number, table.c.frame_id.in_(frame_ids))
            .order_by(table.c.frame_id, table.c.k)
        )
        found = bulk.grouped(self.database.rows(query), frame_ids)
        return {key: Detections.from_rows(rows) for key, rows in found.items()}


def open_dataset(config: Config) -> Dataset:
    """Return the data set that a configuration specifies.

    Raises:
        ConfigError: if a setting is invalid, or the class of the data set does not accept it.
        DataError: if the root does not contain such a data set.
    """
    section = config.dataset
    settings = {key: getattr(section, key) for key in _LAYOUT_SETTINGS}
    given = [key for key, value in settings.items() if value is not None]
    if given and not registry.DATASETS.takes(section.kind, "layout"):
        raise ConfigError(
            f"dataset.{given[0]}: data set '{section.kind}' has no argument layout, which would "
            "receive this setting; remove it"
        )
    try:
        layout = PointLayout(**settings)
    except ConfigError as error:
        raise ConfigError(f"dataset.{error}") from None
    dataset: Dataset = registry.DATASETS.build(
        section.kind,
        section.root,
        offered={
            "follow_links": lambda: section.follow_links,
            "layout": lambda: layout,
            # Names are renamed after reading. A class with a mapping of its own must not use it.
            **({} if section.rename is None else {"rename": dict}),
        },
        options=section.options,
    )
    return dataset


def read_truth(config: Config, dataset: Dataset, frame: str) -> Annotations:
    """Return the ground truth of a frame with the names of `dataset.rename`."""
    return with_final_names(config, dataset.annotations(frame))


def with_final_names(config: Config, truth: Annotations) -> Annotations:
    """Return ground truth with the names of `dataset.rename`; DontCare regions lose their box."""
    found = renamed(truth, config.dataset.rename)
    if found is truth:
        return truth
    region = (found.categories == DONT_CARE)[:, None]
    return replace(found, boxes=np.where(region, np.nan, found.boxes))


def sha256(path: Path) -> str:
    """Return the hash of a file, or of the files in a folder with their names.

    Raises:
        ConfigError: if there is no such file, or it is a pipe or a device, which may never end.
    """
    if not path.exists():
        raise ConfigError(f"{path}: no such file")
    if not (path.is_file() or path.is_dir()):
        raise ConfigError(f"{path}: is a pipe or a device; specify a file or a folder")
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
        if file != path:
            digest.update(f"{file.relative_to(path)}\0".encode())
        with file.open("rb") as stream:
            digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()


def stat_fingerprint(path: Path) -> str:
    """Return a hash of the names, sizes and modification times of the files in a folder.

    It detects changes without reading large files. Copied files count as changed.
    """
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file()):
        state = file.stat()
        entry = f"{file.relative_to(path)}\0{state.st_size} {state.st_mtime_ns}\n"
        digest.update(entry.encode())
    return digest.hexdigest()


def anchored(root: Path, config: Config) -> Config:
    """Return the configuration with relative paths resolved against the workspace folder."""
    changes: dict[str, Any] = {}
    detector = ("path", "augmented", "unseen")
    paths = {"dataset": ("root",), "detector": detector, "segmenter": ("path",)}
    for name, keys in paths.items():
        section = getattr(config, name)
        found = {key: getattr(section, key) for key in keys}
        update = {key: root / path for key, path in found.items() if isinstance(path, Path)}
        if update:
            changes[name] = section.model_copy(update=update)
    segmenter = changes.get("segmenter", config.segmenter)
    cache = root / (segmenter.cache or "maps")
    changes["segmenter"] = segmenter.model_copy(update={"cache": cache})
    return config.model_copy(update=changes)


def _annotations(rows: Sequence[Sequence[Any]]) -> Annotations:
    if not rows:
        return Annotations.empty()
    categories, *numbers = zip(*rows, strict=True)
    table = np.array(numbers, dtype=np.float64).T
    return Annotations(
        boxes=table[:, :7],
        categories=np.array(categories),
        truncated=table[:, 7],
        occluded=table[:, 8].astype(np.int64),
        alpha=table[:, 9],
        boxes_2d=table[:, 10:],
    )
