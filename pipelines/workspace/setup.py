"""Set-up of a workspace: the split of the frames, and the ground truth of labeled frames."""

import logging
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import func, select

from curate.category_names import NamedSide, compare_names, inline_table
from curate.datasets.base import Dataset, sequences_of
from curate.datasets.formats.containment import check_frame_id
from curate.datasets.frame_names import FrameNames, match_frame_list
from curate.datasets.kitti.labels import KITTI_CATEGORIES
from curate.datasets.recognition import label_hint
from curate.detections import Annotations
from curate.errors import ConfigError, DataError, LeakageError, WorkspaceError
from curate.exporters.base import named
from curate.files.batches import batched
from curate.firewall.sequences import choose_sequences, group_by_sequence, shared_sequences
from curate.segmenters.classes import missing_classes
from curate.spelling import closest, did_you_mean
from db import bulk
from db.models import BOX_COLUMNS, RECTANGLE_COLUMNS
from pipelines import registry
from pipelines.workspace.config import Config
from pipelines.workspace.images import check_reference
from pipelines.workspace.samples import check_samples
from pipelines.workspace.split_record import split_rows
from pipelines.workspace.splits import SPLITS, WITH_TRUTH
from pipelines.workspace.workspace import Workspace, open_dataset, with_final_names

_log = logging.getLogger(__name__)

FRAMES_AT_ONCE = 1024
# "Person" is the name of KITTI's tracking benchmark for Person_sitting.
_BENCHMARK_NAMES = KITTI_CATEGORIES | {"Person"}


@dataclass(frozen=True)
class Split:
    """Frame names per split; no frame is in two of them."""

    labeled: tuple[str, ...]
    unlabeled: tuple[str, ...]
    val: tuple[str, ...]
    calibration: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raise LeakageError if two splits share a frame."""
        for one, other in combinations(SPLITS, 2):
            shared = sorted(set(getattr(self, one)) & set(getattr(self, other)))
            if shared:
                raise LeakageError(f"frames in both {one} and {other}: {', '.join(shared[:5])}")


def initialise(
    root: Path,
    config: Config,
    labeled: str,
    val: str,
    calibration: str = "",
    *,
    compare: bool = True,
) -> Workspace:
    """Return a workspace with its frames, and their ground truth except that of X_u.

    Everything is read before anything is written: a damaged file leaves no incomplete workspace.

    Args:
        root: folder of the workspace.
        config: its settings.
        labeled: share of the training frames, e.g. "0.04", or a file with a frame name per line.
        val: the same for val frames; "" for the data set's own val list.
        calibration: share of the val frames that is set aside for calibration, or a file; "" for
            none.
        compare: whether to compare the names in the label files with `dataset.categories`.

    Raises:
        ConfigError: if a share or a list is invalid, a class or file is missing, or the label files
            have no name of `dataset.categories`.
        DataError: if a label or calibration file is damaged, or has an unknown name.
        WorkspaceError: if the workspace exists with other frames or settings.
    """
    check_files(config)
    dataset = open_dataset(config)
    split = choose_split(
        dataset, labeled, val, config.run.seed, config.dataset.split_by, calibration
    )
    check_reference(config, split.labeled)
    check_samples(dataset, sorted(name for each in SPLITS for name in getattr(split, each)))
    annotated = [name for each in WITH_TRUTH for name in getattr(split, each)]
    truth = {name: dataset.annotations(name) for name in annotated}
    if compare:
        _compare_names(config, dataset, truth)
    truth = {name: with_final_names(config, found) for name, found in truth.items()}
    workspace = Workspace.create(root, config)
    stored = Split(*(tuple(workspace.frames(name)) for name in SPLITS))
    if stored == split:
        return workspace
    if any(getattr(stored, name) for name in SPLITS):
        raise WorkspaceError(
            f"{workspace.root}: exists with another split of the frames; choose another folder"
        )
    lists = {"labeled": labeled, "val": val, "calibration": calibration}
    files = {name: Path(each) for name, each in lists.items() if each and Path(each).is_file()}
    _store(workspace, dataset, split, truth, files)
    return workspace


def label_names(config: Config, names: Mapping[str, int], *, original: bool) -> NamedSide:
    """Return the names in the label files of X_l and val, for a comparison.

    Args:
        config: the configuration.
        names: number of objects by name.
        original: whether the names are those of the label files; false for stored names.
    """
    kind = config.dataset.kind
    # nuScenes' classes are a fixed list, of which a user chooses some.
    accepted = set(names) if kind == "nuscenes" else _BENCHMARK_NAMES
    rename = config.dataset.rename or {}
    return NamedSide("the label files", names, "dataset.rename", rename, accepted, original)


def _compare_names(config: Config, dataset: Dataset, truth: Mapping[str, Annotations]) -> None:
    """Compare the names in the label files with `dataset.categories`, and warn of differences.

    Raises:
        ConfigError: if no name is the same, or one differs only in its letters.
        DataError: if the data set is in KITTI's layout, and a name is neither KITTI's nor declared:
            it may be a typing error.
    """
    names = Counter(name for found in truth.values() for name in found.categories.tolist())
    side = label_names(config, dict(sorted(names.items())), original=True)
    findings = compare_names(side, config.dataset.categories)
    if wrong := [finding.message for finding in findings if finding.wrong]:
        raise ConfigError("; ".join(wrong))
    known = {*config.dataset.categories, *side.accepted, *side.rename}
    if config.dataset.kind.startswith("kitti"):
        unknown = [name for name in side.names if name not in known]
        for frame, found in truth.items():
            for name in found.categories.tolist():
                if name in unknown:
                    helps = {each: closest(each, known) or each for each in unknown}
                    raise _unknown_name(dataset, frame, name, known, {**side.rename, **helps})
    for finding in findings:
        _log.warning("%s", finding.message)


def _unknown_name(
    dataset: Dataset, frame: str, name: str, known: Collection[str], rename: Mapping[str, str]
) -> DataError:
    """Return the error for a name in the label file of a frame, with the mapping that helps."""
    path = dataset.files(frame).label
    lines = path.read_bytes().splitlines() if path else []
    line = next((i for i, text in enumerate(lines, 1) if text.split()[:1] == [name.encode()]), 1)
    verb = "leave it out with" if rename[name] == name else "map it with"
    return DataError(
        f"{path}:{line}: unknown category {name[:40]!r}{did_you_mean(name, known)}; known are "
        f"{', '.join(sorted(known))}; add it to dataset.categories, or {verb} --set "
        f"'dataset.rename={inline_table(rename)}'"
    )


def check_files(config: Config) -> None:
    """Check the files of detector and segmenter.

    Raises:
        ConfigError: if a file is missing, or the meaning of the segmenter's class ids is not given.
    """
    needs_path = {"detector": ("onnx", "recorded"), "segmenter": tuple(registry.SEGMENTERS.classes)}
    for section, names in needs_path.items():
        name, path = getattr(config, section).name, getattr(config, section).path
        if path is None and name in names:
            raise ConfigError(f"{section} '{name}' needs a path: give --{section}-path")
        if path is not None and not path.exists():
            raise ConfigError(f"--{section}-path {path}: no such file")
    name, segmenter = config.segmenter.name, config.segmenter
    if (
        segmenter.classes is None
        and name in registry.SEGMENTERS.classes
        and registry.SEGMENTERS.takes(name, "classes")
        and "classes" not in segmenter.options
    ):
        raise missing_classes(name)


def choose_split(
    dataset: Dataset,
    labeled: str,
    val: str,
    seed: int,
    split_by: str = "sequence",
    calibration: str = "",
) -> Split:
    """Choose which frames are labeled, unlabeled, val and set aside for calibration.

    If the data set has sequences, each goes into one split as a whole, unless `split_by` is
    "frame".

    Raises:
        ConfigError: if a share or a list is invalid.
        DataError: if the data set has no frames.
        LeakageError: if user-supplied lists put a sequence into two splits.
    """
    lists = dataset.splits()
    frames = lists.get("train") or dataset.frame_ids()
    if not frames:
        raise DataError("the data set has no frames; check --root, and --dataset for its layout")
    all_sequences = sequences_of(dataset, {*frames, *lists.get("val", ())})
    sequences = all_sequences if split_by == "sequence" else {}
    if all_sequences and not sequences:
        _log.warning(
            "splitting by frame: several splits will contain near-duplicate frames of one "
            "sequence, and results on val frames will be too optimistic"
        )
    generator = np.random.default_rng(seed)
    held_out: Sequence[str] = lists.get("val", ())
    if val:
        held_out = _choose(dataset, frames, val, generator, "val", sequences)
    without_label = [frame for frame in held_out if not dataset.files(frame).label]
    if without_label:
        raise ConfigError(
            f"val frame {without_label[0]} has no label file; give --val 0 for no val "
            f"frames, or a list of frames that have one{_label_hint(dataset)}"
        )
    pool = [frame for frame in frames if frame not in set(held_out)]
    chosen = _choose(dataset, pool, labeled, generator, "labeled", sequences)
    set_aside: Sequence[str] = ()
    if calibration:
        # Drawn after the others: those are the same with and without it.
        set_aside = _choose(dataset, held_out, calibration, generator, "calibration", sequences)
        if not set_aside and Path(calibration).is_file():
            raise ConfigError(f"--calibration {calibration}: the file lists no frame")
    rest = set(pool) - set(chosen)
    kept = set(held_out) - set(set_aside)
    found = Split(*(tuple(sorted(each)) for each in (chosen, rest, kept, set_aside)))
    for split in SPLITS:
        for frame in getattr(found, split):
            check_frame_id(frame)
    _check_sequences(sequences, found)
    return found


def _check_sequences(sequences: Mapping[str, str], split: Split) -> None:
    """Raise LeakageError if a sequence is in two splits."""
    shared = shared_sequences(sequences, {name: getattr(split, name) for name in SPLITS})
    for (one, other), names in shared.items():
        raise LeakageError(
            f"{len(names)} sequences ({named(names)}) have frames in both {one} and {other}, which "
            "are near-duplicates of each other: give whole sequences (a list may contain sequence "
            "names), or split by frame with --split-by frame"
        )


def _choose(
    dataset: Dataset,
    pool: Sequence[str],
    selection: str,
    generator: np.random.Generator,
    split: str,
    sequences: Mapping[str, str],
) -> list[str]:
    """Choose frames with a label file, by share or from a list; by sequence if there are any."""
    if Path(selection).is_file():
        return _listed(dataset, pool, Path(selection), split)
    try:
        share = float(selection)
    except ValueError:
        share = -1.0
    if not 0 <= share <= 1:
        raise ConfigError(
            f"--{split} {selection}: give a share between 0 and 1, or a file of frame ids"
        )
    if share == 0:
        return []
    if not pool:
        reason = "all frames are val frames already; give --val a share below 1"
        if split == "calibration":
            reason = "it is a share of the val frames, and there are none; give --val a share"
        raise ConfigError(f"--{split} {selection}: {reason} or a file of frame ids")
    with_label = [name for name in sorted(pool) if dataset.files(name).label]
    count = max(1, round(share * len(pool)))
    if count > len(with_label):
        raise ConfigError(
            f"--{split} {selection} needs {count} frames, but only {len(with_label)} of "
            f"{len(pool)} have a label file; give a smaller share (0 for none)"
        )
    if sequences:
        groups = group_by_sequence(sequences, pool)
        whole = {name for name, frames in groups.items() if set(frames) <= set(with_label)}
        candidates = [frame for name in sorted(whole) for frame in groups[name]]
        if not candidates:
            raise ConfigError(
                f"--{split} {selection}: no sequence has a label file for each of its frames; give "
                "a list of frames, or split by frame with --split-by frame"
            )
        return choose_sequences(sequences, candidates, count, generator)
    return list(generator.permutation(with_label)[:count].tolist())


def _listed(dataset: Dataset, pool: Sequence[str], path: Path, split: str) -> list[str]:
    """Return the frames that a file lists, without repetition; a sequence means all its frames."""
    groups = group_by_sequence(sequences_of(dataset, pool), pool)
    frames = FrameNames.of_dataset(dataset)
    try:
        names = match_frame_list(path, frames, groups=groups, error_type=ConfigError)
    except ConfigError as error:
        raise ConfigError(f"--{split} {error}") from None
    outside = sorted(set(names) - set(pool))
    if outside:
        among = "val" if split == "calibration" else "training"
        raise ConfigError(f"--{split} {path}: frame {outside[0]} is not among the {among} frames")
    without_label = [name for name in names if not dataset.files(name).label]
    if without_label:
        raise ConfigError(
            f"--{split} {path}: frame {without_label[0]} has no label file{_label_hint(dataset)}"
        )
    return list(names)


def _label_hint(dataset: Dataset) -> str:
    root = getattr(dataset, "root", None)
    return label_hint(root) if isinstance(root, Path) else ""


def _store(
    workspace: Workspace,
    dataset: Dataset,
    split: Split,
    truth: dict[str, Annotations],
    files: Mapping[str, Path],
) -> None:
    table = bulk.table("frame")
    with workspace.database.writing() as connection:
        if connection.execute(select(func.count()).select_from(table)).scalar_one():
            raise WorkspaceError(f"{workspace.root}: another command has just initialised it")
        for rows in batched(_frame_rows(workspace, dataset, split), FRAMES_AT_ONCE):
            bulk.insert_rows(connection, "frame", rows)
        chosen = {name: getattr(split, name) for name in SPLITS}
        bulk.insert_rows(connection, "split_list", split_rows(chosen, dataset.splits(), files))
        query = select(table.c.frame, table.c.id, table.c.split).where(table.c.split != "unlabeled")
        keys = {frame: (key, name) for frame, key, name in bulk.select(connection, query)}
        truth_rows = [
            row for frame, found in truth.items() for row in _truth_rows(*keys[frame], found)
        ]
        bulk.insert_rows(connection, "ground_truth", truth_rows)


def _frame_rows(workspace: Workspace, dataset: Dataset, split: Split) -> Iterator[dict[str, Any]]:
    """Yield the rows of `frame`; for X_u, not even the path of a label file is stored."""
    root, kind = workspace.config.dataset.root, workspace.config.dataset.kind
    for name in SPLITS:
        for frame in getattr(split, name):
            found = dataset.files(frame)
            label = None if name == "unlabeled" else found.label
            paths = {
                "points_path": found.points,
                "image_path": found.image,
                "calibration_path": found.calibration,
                "label_path": label,
            }
            relative = {key: str(p.relative_to(root)) if p else None for key, p in paths.items()}
            yield {"dataset": kind, "frame": frame, "split": name, **relative}


def _truth_rows(frame_id: int, split: str, found: Annotations) -> list[dict[str, Any]]:
    """Return the rows of `ground_truth`; DontCare regions have no box."""
    rows = []
    for k in range(len(found)):
        box = [None if np.isnan(number) else float(number) for number in found.boxes[k]]
        row = {
            "frame_id": frame_id,
            "k": k,
            "split": split,
            "category": str(found.categories[k]),
            "truncated": float(found.truncated[k]),
            "occluded": int(found.occluded[k]),
            "alpha": float(found.alpha[k]),
        }
        row |= zip(BOX_COLUMNS, box, strict=True)
        row |= zip(RECTANGLE_COLUMNS, found.boxes_2d[k].tolist(), strict=True)
        rows.append(row)
    return rows
