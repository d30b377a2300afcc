"""Rules about splits: as init chose them, by lists that did not change, sequences in one."""

from curate.datasets.base import sequences_of
from curate.exporters.base import named
from curate.firewall.sequences import straddling
from pipelines.firewall.finding import Finding
from pipelines.workspace.split_record import SplitRecord, changed_lists
from pipelines.workspace.workspace import Workspace


def recorded_splits(record: SplitRecord) -> Finding:
    """Return the splits of the database are those that init recorded."""
    rule = "splits are those of init"
    if record.damaged:
        fault = f"the record of {', '.join(record.damaged)} does not fit its hash"
    elif changed := record.changed:
        fault = "; ".join(f"{split}: {what}" for split, what in changed.items())
    elif not record.lists and any(record.splits.values()):
        fault = "the record is gone"
    else:
        told = (f"{len(frames)} {split}" for split, frames in record.splits.items())
        return Finding(rule, True, ", ".join(told))
    remedy = (
        "the database was changed: restore a backup, or make a new workspace with `curate init`"
    )
    return Finding(rule, False, fault, remedy)


def unchanged_lists(workspace: Workspace, record: SplitRecord) -> Finding:
    """Return the lists of the data set, and those that init was given, are as they were."""
    rule = "split lists are unchanged"
    outside = sum(found.source != "chosen" for found in record.lists)
    changed = changed_lists(workspace, record)
    if not changed:
        return Finding(rule, True, f"{outside} lists of the data set or given to init")
    told = "; ".join(f"{name}: {what}" for name, what in changed.items())
    remedy = "restore the list, or make a new workspace with `curate init` for the new one"
    return Finding(rule, False, told, remedy)


def sequences_apart(workspace: Workspace, record: SplitRecord) -> Finding:
    """No sequence has frames in two splits."""
    rule = "sequences are in one split"
    splits = {split: tuple(frames) for split, frames in record.splits.items()}
    sequences = sequences_of(workspace.dataset, list(record.split_of))
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
