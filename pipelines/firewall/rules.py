"""Run the firewall rules: all of them for `curate check`, the fast ones before a command."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from curate.errors import DataError
from curate.exporters.label_file import LabelFileFrames, read_frames
from pipelines.firewall.files import duplicates, label_files, object_bank
from pipelines.firewall.finding import Finding, raise_finding
from pipelines.firewall.splits import recorded_splits, sequences_apart, unchanged_lists
from pipelines.firewall.truth import copied_truth, predicted_rounds, stored_truth
from pipelines.workspace.split_record import SplitRecord
from pipelines.workspace.workspace import Workspace


def check(workspace: Workspace) -> Iterator[Finding]:
    """Check all rules on the whole workspace; yield a finding per rule."""
    record = SplitRecord.read(workspace)
    yield from _of_the_database(workspace, record)
    yield copied_truth(workspace, record, predicted_rounds(workspace), thorough=True)
    files: dict[Path, LabelFileFrames] = {}
    for path in sorted((workspace.root / "exports").glob("*.sqlite")):
        try:
            files[path] = read_frames(path)
        except DataError as error:
            yield Finding("label files can be read", False, str(error))
    yield label_files(workspace, record, files)
    yield object_bank(workspace, record, files)
    yield duplicates(workspace, record)


def enforce(workspace: Workspace, round_number: int = 0, file: Path | None = None) -> None:
    """Check the rules before a command exports or trains.

    Predictions are compared with label files only for a sample of frames, and files are not
    compared with each other; `check` does both in full.

    Args:
        workspace: see `Workspace`.
        round_number: round of the predictions that are exported or trained on; 0 for none.
        file: the label file that is written or read; it need not exist yet.

    Raises:
        LeakageError: if a rule is broken; the message names the frames and the remedy.
        DataError: if the label file is damaged.
    """
    record = SplitRecord.read(workspace)
    for finding in _of_the_database(workspace, record):
        raise_finding(finding)
    if round_number:
        raise_finding(copied_truth(workspace, record, [round_number], thorough=False))
    files: Mapping[Path, LabelFileFrames] = {}
    if file is not None and file.exists():
        files = {file: read_frames(file)}
    raise_finding(label_files(workspace, record, files))
    raise_finding(object_bank(workspace, record, files))


def _of_the_database(workspace: Workspace, record: SplitRecord) -> Iterator[Finding]:
    yield recorded_splits(record)
    yield unchanged_lists(workspace, record)
    yield sequences_apart(workspace, record)
    yield stored_truth(workspace)
