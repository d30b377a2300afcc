"""Write a 3D recording of frames of a round, with the stored evidence of each label."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from sqlalchemy import select

from curate.errors import ConfigError
from curate.viewing.recording import RecordedFrame, load_rerun, write_recording
from db import bulk
from db.views import weighted_labels
from pipelines.labels.columns import numeric_columns
from pipelines.labels.of_one_frame import read_frame
from pipelines.reports.pictures import shown_labels
from pipelines.workspace.workspace import Workspace


def record_frames(
    workspace: Workspace, names: Sequence[str], round_number: int, policy: str, output: Path
) -> Path:
    """Write the recording and return its path.

    Args:
        workspace: see `Workspace`.
        names: names of the frames, in the order of the timeline.
        round_number: the round with the predictions.
        policy: the policy that gave the weights.
        output: path of the .rrd file.

    Raises:
        ConfigError: if rerun is not installed, a frame is unknown, or the file cannot be written.
    """
    load_rerun()
    if output.suffix != ".rrd" or output.is_dir() or not output.parent.is_dir():
        raise ConfigError(f"--rerun {output}: must be an .rrd file in an existing folder")
    write_recording(output, _recorded(workspace, names, round_number, policy))
    return output


def _recorded(
    workspace: Workspace, names: Sequence[str], round_number: int, policy: str
) -> Iterator[RecordedFrame]:
    """Yield the frames one at a time, because their points may not fit into memory together."""
    for name in names:
        found = read_frame(workspace, name, round_number, policy)
        frame = workspace.dataset.read(name, image=True)
        labels = shown_labels(workspace, frame, found, policy)
        evidence = evidence_of_labels(workspace, name, round_number, policy, found.numbers)
        if labels.points is not None:
            evidence["points"] = labels.points.astype(np.float64)
        yield RecordedFrame(
            frame,
            labels,
            evidence,
            found.repredictions,
            found.truth_boxes,
            None if found.truth is None else found.truth.categories,
            f"frame {name} ({found.split}), round {round_number}, weights by {policy}; "
            f"weight 0: {labels.zero_weight}",
        )


def evidence_of_labels(
    workspace: Workspace, name: str, round_number: int, policy: str, numbers: np.ndarray
) -> dict[str, np.ndarray]:
    """Return (n,) values of each evidence column for n labels given by k; NaN if missing."""
    with workspace.database.reading() as connection:
        labels = weighted_labels(connection).c
        columns = [each for each in numeric_columns(connection) if each not in ("score", "weight")]
        query = select(labels.k, *(labels[column] for column in columns)).where(
            labels.round == round_number, labels.frame == name, labels.policy == policy
        )
        table = np.full((len(numbers), len(columns)), np.nan)
        rows = {k: row for row, k in enumerate(numbers.tolist())}
        for k, *values in bulk.select(connection, query):
            if k in rows:
                table[rows[k]] = values
    return dict(zip(columns, table.T, strict=True))
