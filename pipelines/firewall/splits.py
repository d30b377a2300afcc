"""Rules about splits: as init chose them, by lists that did not change, sequences in one."""

from curate.datasets.base import sequences_of
from curate.exporters.base import named
from curate.firewall.sequences import straddling
from pipelines.firewall.finding import Finding
from pipelines.firewall.record import (
    changed_lists,
    changed_splits,
    damaged_records,
    recorded_lists,
)
from pipelines.workspace import SPLITS, Workspace


def recorded_splits(workspace: Workspace) -> Finding:
    """The splits of the database are those that init recorded."""
    rule = "splits are those of init"
    counts = {split: len(workspace.frames(split)) for split in SPLITS}
    told = ", ".join(f"{count} {split}" for split, count in counts.items())
    changed = changed_splits(workspace)
    damaged = damaged_records(workspace)
    if damaged:
        fault = f"the record of {', '.join(damaged)} does not fit its hash"
    elif changed:
        fault = "; ".join(f"{split}: {what}" for split, what in changed.items())
    elif not recorded_lists(workspace) and any(counts.values()):
        fault = "the record is gone"
    else:
        return Finding(rule, True, told)
    remedy = (
        "the database was changed: restore a backup, or make a new workspace with `curate init`"
    )
    return Finding(rule, False, fault, remedy)


def unchanged_lists(workspace: Workspace) -> Finding:
    """The lists of the data set, and those that init was given, are as they were."""
    rule = "split lists are unchanged"
    lists = [key for key in recorded_lists(workspace) if key[0] != "chosen"]
    changed = changed_lists(workspace)
    if not changed:
        return Finding(rule, True, f"{len(lists)} lists of the data set or given to init")
    told = "; ".join(f"{name}: {what}" for name, what in changed.items())
    remedy = "restore the list, or make a new workspace with `curate init` for the new one"
    return Finding(rule, False, told, remedy)


def sequences_apart(workspace: Workspace) -> Finding:
    """No sequence has frames in two splits."""
    rule = "sequences are in one split"
    splits = {split: tuple(workspace.frames(split)) for split in SPLITS}
    frames = [frame for of_split in splits.values() for frame in of_split]
    sequences = sequences_of(workspace.dataset, frames)
    if not sequences:
        return Finding(rule, True, "the data set knows no sequences")
    shared = straddling(sequences, splits)
    told = ", ".join(
        f"{len(names)} in both {one} and {other} ({named(names)})"
        for (one, other), names in shared.items()
    )
    count = f"{len(set(sequences.values()))} sequences"
    if workspace.config.dataset.split_by == "frame":
        return Finding(rule, True, f"waived by dataset.split_by = frame: {count}, {told or 'all'}")
    remedy = (
        "make a new workspace, which splits by sequence; dataset.split_by = frame in curate.toml "
        "waives the rule"
    )
    return Finding(rule, not shared, told or f"{count}, each in one split", remedy)
