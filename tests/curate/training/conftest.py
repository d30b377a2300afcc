"""Label files over small frames."""

from pathlib import Path

import pytest

from curate.datasets.kitti.dataset import KittiDataset
from curate.exporters.base import LabelFileDescription
from curate.exporters.sqlite import write_labels

NAMES = ("Car", "Pedestrian", "Cyclist")


@pytest.fixture
def make_labels(toy_kitti, tmp_path):
    """Writes a label file: `labeled` frames with ground truth, `unlabeled` ones with weights."""
    dataset = KittiDataset(toy_kitti)

    def make(labeled=4, unlabeled=0, weight=0.5, name="labels.sqlite", categories=NAMES) -> Path:
        ids = dataset.frame_ids()[: labeled + unlabeled]
        splits = dict.fromkeys(ids[:labeled], "labeled") | dict.fromkeys(ids[labeled:], "unlabeled")
        truth, labels = [], []
        for frame, split in splits.items():
            annotations = dataset.annotations(frame)
            for k, box in enumerate(annotations.boxes.tolist()):
                category = str(annotations.categories[k])
                if split == "labeled":
                    truth.append((frame, k, category, *box, 0.0, 0))
                else:
                    evidence = (
                        0.9,
                        0.2,
                        30,
                        60.0,
                        0.5,
                        80,
                        100,
                        0.8,
                        0.4,
                        1.5,
                        "detector",
                        "pspsl",
                        weight,
                    )
                    labels.append((1, frame, k, category, *box, *evidence))
        write_labels(
            tmp_path / name,
            description=LabelFileDescription("kitti", toy_kitti, categories, 1, "pspsl", "1"),
            frames=[(frame, split, "p", "i", "c") for frame, split in splits.items()],
            ground_truth=truth,
            labels=labels,
        )
        return tmp_path / name

    return make
