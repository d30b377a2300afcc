"""docs/training.md: its example runs, and the dataset needs neither db nor pipelines."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.exported import block, label, toy_frame, truth, truth_block
from support.paths import ROOT
from support.toys import SIZES, write_toy_kitti

from curate.exporters.base import FrameFiles, LabelFileDescription, LabelSet
from curate.exporters.sqlite import SqliteExporter
from curate.weighting.base import ZeroWeight
from pipelines.registry import EXPORTERS

PAGE = ROOT / "docs" / "training.md"
# As if a user's own db.py and pipelines.py were imported first.
BLOCKED = "import sys\nsys.modules['db'] = sys.modules['pipelines'] = None\n"


def write_labels(tmp_path: Path, zero_weight: ZeroWeight) -> Path:
    """Write a labeled frame with a car, an unlabeled one with three labels of weight 0 to 1."""
    root = tmp_path / "kitti"
    write_toy_kitti(root, frames=2)
    files = [
        tuple(f"training/{folder}/{name}.{suffix}" for folder, suffix in
              (("velodyne", "bin"), ("image_2", "png"), ("calib", "txt")))
        for name in ("000000", "000001")
    ]  # fmt: skip
    rows = [
        label("000001", k, (8.0 + 6 * k, 0.0, -0.8, *SIZES["Car"], 0.1), weight=k / 2)
        for k in range(3)
    ]
    path = tmp_path / "labels.sqlite"
    given = LabelSet(
        LabelFileDescription("kitti", root, tuple(SIZES), 1, "pspsl", "1", zero_weight),
        [FrameFiles("000000", "labeled", *files[0]), FrameFiles("000001", "unlabeled", *files[1])],
        truth_block([truth("000000", box=(12.0, 1.0, -0.8, *SIZES["Car"], 0.3))]),
        [block(rows)],
        read=toy_frame,
        read_points=toy_frame,
    )
    SqliteExporter().write(path, given)
    return path


@pytest.fixture
def labels(tmp_path: Path) -> Path:
    """Return a label file in which weight 0 is ignored."""
    return write_labels(tmp_path, "ignore")


def run(code: str, *arguments: object) -> str:
    """Return the output of a Python process without db and pipelines."""
    ended = subprocess.run(
        [sys.executable, "-c", BLOCKED + code, *map(str, arguments)],
        capture_output=True, text=True, check=False, cwd=PAGE.parent.parent,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


# The gradients at the three labels of the unlabeled frame, and beside all of them.
CHECK = """
found, codes, weight = targets(labels[1])
output = torch.zeros(1600, 7, requires_grad=True)
weighted_loss(output, found, codes, weight, 1).backward()
print([output.grad[(cells - torch.tensor([x, 0.5])).norm(dim=1).argmin(), 0].item()
       for x in (8.5, 14.5, 20.5, 35.5)])
"""


def definitions() -> str:
    """Return the example up to the training loop."""
    example = re.search(r"<!-- plain pytorch.*?```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert example is not None
    return example[1].partition("torch.manual_seed")[0]


def test_the_torch_dataset_needs_neither_db_nor_pipelines(labels: Path) -> None:
    """From the file to weights in a user's own training script."""
    code = (
        "import sys, pathlib\n"
        "from torch.utils.data import DataLoader\n"
        "from curate.training.labels import WeightedLabels\n"
        "data = WeightedLabels(pathlib.Path(sys.argv[1]))\n"
        "loader = DataLoader(data, batch_size=2, collate_fn=list)\n"
        "print([s.weights.tolist() for batch in loader for s in batch])\n"
    )
    assert run(code, labels) == "[[1.0], [0.0, 0.5, 1.0]]\n"


def test_the_plain_pytorch_example_learns(labels: Path, tmp_path: Path) -> None:
    """It runs as printed, its loss falls, and it writes its checkpoint."""
    example = re.search(r"<!-- plain pytorch.*?```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert example is not None
    printed = run(example[1], labels, tmp_path / "student.pt")
    losses = [float(line.rpartition(" ")[2]) for line in printed.splitlines()]
    assert len(losses) == 3
    assert losses == sorted(losses, reverse=True)
    assert (tmp_path / "student.pt").stat().st_size > 0


def test_the_example_uses_the_weights(labels: Path) -> None:
    """No gradient in the region of a label with v = 0; half of it for v = 0.5."""
    assert run(definitions() + CHECK, labels) == "[0.0, -0.25, -0.5, 0.5]\n"


def test_the_example_distinguishes_background(tmp_path: Path) -> None:
    """If weight 0 is background, the region of such a label has a background gradient."""
    path = write_labels(tmp_path, "background")
    assert run(definitions() + CHECK, path) == "[0.5, -0.25, -0.5, 0.5]\n"


def test_every_format_is_described() -> None:
    """And no unregistered one."""
    page = (ROOT / "docs" / "exports.md").read_text()
    named = set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE))
    assert named == set(EXPORTERS.classes)
