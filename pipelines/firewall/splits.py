"""Rules about splits: unchanged since init, and no sequence in two of them."""

from curate.datasets.base import sequences_of
from curate.exporters.base import named
from curate.firewall.sequences import shared_sequences
from pipelines.firewall.finding import Finding
from pipelines.workspace.split_record import SplitRecord, changed_lists
from pipelines.workspace.splits import count_frames
from pipelines.workspace.workspace import Workspace


def recorded_splits(record: SplitRecord) -> Finding:
    """Check that the splits in the database are those that init recorded."""
    rule = "splits are those of init"
    if record.damaged:
        problem = f"the record of {', '.join(record.damaged)} does not match its hash"
    elif changed := record.changed:
        problem = "; ".join(f"{split}: {what}" for split, what in changed.items())
    elif not record.lists and any(record.splits.values()):
        problem = "the record is missing"
    else:
        counts = (f"{count} {split}" for split, count in count_frames(record.splits).items())
        return Finding(rule, True, ", ".join(counts))
    remedy = (
        "the database was changed: restore a backup, or create a new workspace with `curate init`"
    )
    return Finding(rule, False, problem, remedy)


def unchanged_lists(workspace: Workspace, record: SplitRecord) -> Finding:
    """Check that the lists of the data set, and those given to init, are unchanged."""
    rule = "split lists are unchanged"
    outside = sum(found.source != "chosen" for found in record.lists)
    changed = changed_lists(workspace, record)
    if not changed:
        return Finding(rule, True, f"{outside} lists of the data set or given to init")
    message = "; ".join(f"{name}: {what}" for name, what in changed.items())
    remedy = "restore the list, or create a new workspace with `curate init` for the new list"
    return Finding(rule, False, message, remedy)


def sequences_apart(workspace: Workspace, record: SplitRecord) -> Finding:
    """Check that no sequence has frames in two splits."""
    rule = "each sequence is in one split"
    splits = {split: tuple(frames) for split, frames in record.splits.items()}
    sequences = sequences_of(workspace.dataset, list(record.split_of))
    if not sequences:
        return Finding(rule, True, "the data set has no sequences")
    shared = shared_sequences(sequences, splits)
    divided = ", ".join(
        f"{len(names)} in both {one} and {other} ({named(names)})"
        for (one, other), names in shared.items()
    )
    count = f"{len(set(sequences.values()))} sequences"
    if workspace.config.dataset.split_by == "frame":
        message = f"waived by dataset.split_by = frame: {count}, {divided or 'each in one split'}"
        return Finding(rule, True, message)
    remedy = (
        "create a new workspace, which is split by sequence; dataset.split_by = frame in "
        "curate.toml waives the rule"
    )
    return Finding(rule, not shared, divided or f"{count}, each in one split", remedy)
