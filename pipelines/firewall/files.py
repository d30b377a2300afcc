"""Rules about files: label files and object banks of the right frames, no recording twice."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from sqlalchemy import select

from curate.exporters.base import named
from curate.exporters.label_file import LabelFileFrames
from curate.firewall.duplicates import HeadHashes, SplitFile, find_duplicates
from db import bulk
from pipelines.firewall.finding import Finding
from pipelines.workspace.split_record import SplitRecord
from pipelines.workspace.workspace import Workspace, sha256

_HASHES = "reports/.file-heads.json"
_AGAIN = "delete it and run `curate export` again"


def label_files(
    workspace: Workspace, record: SplitRecord, files: Mapping[Path, LabelFileFrames]
) -> Finding:
    """The files that trainers read hold X_l and X_u as the workspace does, and were not changed."""
    rule = "label files speak of X_l and X_u"
    own = record.split_of
    digests = _written(workspace)
    labels = objects = 0
    for path, found in files.items():
        fault = _fault(found, own)
        if not fault and digests.get(workspace.relative(path), "") not in ("", sha256(path)):
            fault = "was changed after it was exported"
        if fault:
            return Finding(rule, False, f"{workspace.relative(path)} {fault}", _AGAIN)
        labels, objects = labels + found.labels, objects + found.objects
    told = f"{len(files)} files as exported, {objects} objects of X_l, {labels} labels of X_u"
    return Finding(rule, True, told)


def _fault(found: LabelFileFrames, own: Mapping[str, str]) -> str:
    """What a label file says of frames that the workspace knows better; empty where nothing."""
    held_out = [name for name in found.splits if own.get(name) == "val"]
    strangers = [name for name in found.splits if name not in own]
    moved = [name for name, split in found.splits.items() if own.get(name) != split]
    leaked = [name for name in found.truth if own.get(name) != "labeled"]
    if held_out:
        return f"holds val frames: {named(held_out)}"
    if strangers:
        return f"holds frames that are not in the workspace: {named(strangers)}"
    if leaked:
        return f"holds ground truth of frames that are not of X_l: {named(leaked)}"
    if moved:
        return f"puts frames into another split: {named(moved)}"
    return ""


def _written(workspace: Workspace) -> dict[str, str]:
    """Return the hash of each label file as it was exported."""
    table = bulk.table("label_file")
    return dict(workspace.database.rows(select(table.c.path, table.c.sha256)))


def object_bank(
    workspace: Workspace, record: SplitRecord, files: Mapping[Path, LabelFileFrames]
) -> Finding:
    """Return the bank is cut from the ground truth of label files, or was exported as a folder."""
    rule = "the object bank is of X_l"
    strangers = {name for name, split in record.split_of.items() if split != "labeled"}
    truth = {name for found in files.values() for name in found.truth}
    banks = list((workspace.root / "exports").glob("*/gt_database"))
    cut = {path.stem for bank in banks for path in bank.glob("*.bin")}
    leaked = {name for name in truth if name in strangers}
    leaked |= {name for stem in cut for name in _prefixes(stem) if name in strangers}
    told = f"objects of {len(truth)} frames of X_l, {len(cut)} cut out by exports"
    if leaked:
        told = f"objects of frames outside X_l: {named(leaked)}"
    return Finding(rule, not leaked, told, _AGAIN)


def _prefixes(stem: str) -> Iterator[str]:
    """What could be the frame in FRAME_CATEGORY_K; each may hold underscores itself."""
    return (stem[:i] for i, letter in enumerate(stem) if letter == "_")


def duplicates(workspace: Workspace, record: SplitRecord) -> Finding:
    """No point file or image of one split is that of another under another name."""
    rule = "no recording is in two splits"
    told, count = [], 0
    for kind in ("points", "image"):
        files = [
            SplitFile(split, name, getattr(workspace.dataset.files(name), kind))
            for name, split in record.split_of.items()
        ]
        heads = HeadHashes(workspace.root / _HASHES)
        count += len(files)
        told += [
            f"{one.split} {one.frame} and {other.split} {other.frame} ({kind})"
            for one, other in find_duplicates(files, heads)
        ]
    remedy = "leave one of each pair out of the lists and make a new workspace with `curate init`"
    if not told:
        return Finding(rule, True, f"{count} point files and images differ")
    return Finding(rule, False, f"{len(told)} pairs are the same: {', '.join(told[:3])}", remedy)
