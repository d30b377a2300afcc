"""Label files over small frames."""

from pathlib import Path

import pytest
from support.exported import block, label, truth, truth_block

from curate.datasets.kitti.dataset import KittiDataset
from curate.exporters.base import FrameFiles, LabelFileDescription, LabelSet
from curate.exporters.sqlite import SqliteExporter

NAMES = ("Car", "Pedestrian", "Cyclist")


@pytest.fixture
def make_labels(toy_kitti, tmp_path):
    """Writes a label file: `labeled` frames with ground truth, `unlabeled` ones with weights."""
    dataset = KittiDataset(toy_kitti)

    def make(
        labeled=4, unlabeled=0, weight=0.5, name="labels.sqlite", categories=NAMES,
        zero_weight="ignore", provenance="detector",
    ) -> Path:  # fmt: skip
        ids = dataset.frame_ids()[: labeled + unlabeled]
        splits = dict.fromkeys(ids[:labeled], "labeled") | dict.fromkeys(ids[labeled:], "unlabeled")
        objects, labels = [], []
        for frame, split in splits.items():
            annotations = dataset.annotations(frame)
            for k, box in enumerate(annotations.boxes.tolist()):
                own = {"category": str(annotations.categories[k])}
                if split == "labeled":
                    objects.append(truth(frame, k, box, **own))
                else:
                    own |= {"weight": weight, "provenance": provenance}
                    labels.append(label(frame, k, box, **own))
        description = LabelFileDescription(
            "kitti", toy_kitti, categories, 1, "pspsl", "1", zero_weight
        )
        frames = [FrameFiles(frame, split, "p", "i", "c") for frame, split in splits.items()]
        given = LabelSet(
            description, frames, truth_block(objects), [block(labels)], dataset.read, dataset.read
        )
        SqliteExporter().write(tmp_path / name, given)
        return tmp_path / name

    return make
