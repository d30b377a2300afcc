"""Rules about files: label files and object banks have the right frames, no file has a copy."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from sqlalchemy import select

from curate.exporters.base import named
from curate.exporters.label_file import LabelFileFrames
from curate.firewall.duplicates import HeadHashes, SplitFile, find_duplicates
from db import bulk
from pipelines.firewall.finding import Finding
from pipelines.workspace.split_record import SplitRecord
from pipelines.workspace.splits import HELD_OUT
from pipelines.workspace.workspace import Workspace, sha256

_HASHES = "reports/.file-heads.json"
_REMEDY = "delete it and rerun `curate export`"


def label_files(
    workspace: Workspace, record: SplitRecord, files: Mapping[Path, LabelFileFrames]
) -> Finding:
    """Check that label files agree with the splits and are unchanged since their export."""
    rule = "label files contain only X_l and X_u"
    digests = _exported_hashes(workspace)
    labels = objects = 0
    for path, found in files.items():
        problem = _find_problem(found, record.split_of)
        if not problem and digests.get(workspace.relative(path), "") not in ("", sha256(path)):
            problem = "was changed after it was exported"
        if problem:
            return Finding(rule, False, f"{workspace.relative(path)} {problem}", _REMEDY)
        labels, objects = labels + found.labels, objects + found.objects
    message = f"{len(files)} files as exported, {objects} objects of X_l, {labels} labels of X_u"
    return Finding(rule, True, message)


def _find_problem(found: LabelFileFrames, split_of: Mapping[str, str]) -> str:
    """Describe how a label file contradicts the splits; empty if it does not."""
    held_out = {
        split: [name for name in found.splits if split_of.get(name) == split] for split in HELD_OUT
    }
    unexpected = [name for name in found.splits if name not in split_of]
    moved = [name for name, split in found.splits.items() if split_of.get(name) != split]
    leaked = [name for name in found.truth if split_of.get(name) != "labeled"]
    for split, names in held_out.items():
        if names:
            return f"contains {split} frames: {named(names)}"
    if unexpected:
        return f"contains frames that are not in the workspace: {named(unexpected)}"
    if leaked:
        return f"contains ground truth of frames outside X_l: {named(leaked)}"
    if moved:
        return f"lists frames in the wrong split: {named(moved)}"
    return ""


def _exported_hashes(workspace: Workspace) -> dict[str, str]:
    """Return the hash that each label file had when it was exported, by path."""
    table = bulk.table("label_file")
    return dict(workspace.database.rows(select(table.c.path, table.c.sha256)))


def object_bank(
    workspace: Workspace, record: SplitRecord, files: Mapping[Path, LabelFileFrames]
) -> Finding:
    """Check the frames whose ground truth is in label files or in a folder `gt_database`.

    Trainers cut the objects of the bank from one of the two.
    """
    rule = "the object bank is from X_l"
    outside = {name for name, split in record.split_of.items() if split != "labeled"}
    truth = {name for found in files.values() for name in found.truth}
    banks = list((workspace.root / "exports").glob("*/gt_database"))
    cut = {path.stem for bank in banks for path in bank.glob("*.bin")}
    leaked = {name for name in truth if name in outside}
    leaked |= {name for stem in cut for name in _frame_names(stem) if name in outside}
    message = f"objects of {len(truth)} frames of X_l, {len(cut)} cut out by exports"
    if leaked:
        message = f"objects of frames outside X_l: {named(leaked)}"
    return Finding(rule, not leaked, message, _REMEDY)


def _frame_names(stem: str) -> Iterator[str]:
    """Yield the possible frame names in FRAME_CATEGORY_K; each part may contain underscores."""
    return (stem[:i] for i, letter in enumerate(stem) if letter == "_")


def duplicates(workspace: Workspace, record: SplitRecord) -> Finding:
    """Check that no point file or image of any camera has a copy in another split."""
    rule = "no recording is in two splits"
    pairs, count = [], 0
    found = {name: workspace.dataset.files(name) for name in record.split_of}
    paths_of: dict[str, dict[str, tuple[Path, ...]]] = {
        "points": {name: (files.points,) for name, files in found.items()},
        "image": {name: files.images for name, files in found.items()},
    }
    for kind, paths in paths_of.items():
        files = [
            SplitFile(split, name, path)
            for name, split in record.split_of.items()
            for path in paths[name]
        ]
        heads = HeadHashes(workspace.root / _HASHES)
        count += len(files)
        pairs += [
            f"{one.split} {one.frame} and {other.split} {other.frame} ({kind})"
            for one, other in find_duplicates(files, heads)
        ]
    remedy = (
        "remove one of each pair from the split lists and create a new workspace with `curate init`"
    )
    if not pairs:
        return Finding(rule, True, f"{count} point files and images differ")
    message = f"{len(pairs)} pairs are identical: {', '.join(pairs[:3])}"
    return Finding(rule, False, message, remedy)
