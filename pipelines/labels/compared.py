"""Labels of frames with ground truth, compared with it, and the evidence for them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from curate.calibration.features import LabelEvidence
from pipelines.engine.stage import TruthFrames
from pipelines.labels.label_evidence import read_label_evidence
from pipelines.labels.matching import match_in_frame, match_settings
from pipelines.workspace.config import Config


@dataclass(frozen=True)
class ComparedLabels:
    """The n labels of some frames with ground truth.

    Attributes:
        frames: names of the frames, with or without labels.
        evidence: the evidence of the labels.
        frame: (n,) index of the frame of each label.
        frame_id: (n,) key of that frame in the workspace of its source.
        k: (n,) number of the label within its frame.
        correct: (n,) bool.
        counted: (n,) bool, False for labels that are neither correct nor wrong.
    """

    frames: tuple[str, ...]
    evidence: LabelEvidence
    frame: np.ndarray
    frame_id: np.ndarray
    k: np.ndarray
    correct: np.ndarray
    counted: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the labels of all parts."""
        starts = np.cumsum([0, *(len(part.frames) for part in parts)])[:-1].tolist()
        numbers, flags = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=bool)
        return cls(
            tuple(name for part in parts for name in part.frames),
            LabelEvidence.joined([part.evidence for part in parts]),
            np.concatenate([numbers, *(p.frame + s for p, s in zip(parts, starts, strict=True))]),
            np.concatenate([numbers, *(part.frame_id for part in parts)]),
            np.concatenate([numbers, *(part.k for part in parts)]),
            np.concatenate([flags, *(part.correct for part in parts)]),
            np.concatenate([flags, *(part.counted for part in parts)]),
        )

    def of_frames(self, names: Iterable[str]) -> Self:
        """Return the labels of the frames among some names."""
        wanted = set(names)
        kept = [i for i, name in enumerate(self.frames) if name in wanted]
        rows = np.isin(self.frame, kept)
        return type(self)(
            tuple(self.frames[i] for i in kept),
            self.evidence.select(rows),
            np.searchsorted(kept, self.frame[rows]),
            self.frame_id[rows],
            self.k[rows],
            self.correct[rows],
            self.counted[rows],
        )


def compare_labels(
    found: TruthFrames, config: Config, overlaps: Mapping[str, float]
) -> ComparedLabels:
    """Return the labels of some frames, compared with their ground truth.

    Args:
        found: the frames.
        config: the configuration; `calibrate.overlap` is the kind of overlap that counts.
        overlaps: the IoU threshold of each category.
    """
    workspace, split, number = found.source.workspace, found.source.split, found.context.number
    matching = match_settings(config, config.calibrate.overlap, overlaps)
    names = {key: name for name, key in workspace.frames(split).items()}
    truth = workspace.ground_truth(split)
    order = sorted(found.frames)  # the order of the evidence
    keys, evidence = read_label_evidence(workspace, number, order)
    correct, counted = [np.zeros(0, dtype=bool)], [np.zeros(0, dtype=bool)]
    for key, labels in workspace.labels(number, order).items():
        matches = match_in_frame(workspace, names[key], labels, truth[names[key]], matching)
        correct.append(matches.correct)
        counted.append(matches.counted)
    return ComparedLabels(
        tuple(names[key] for key in order),
        evidence,
        np.searchsorted(order, keys.frame_id),
        keys.frame_id,
        keys.k,
        np.concatenate(correct),
        np.concatenate(counted),
    )
