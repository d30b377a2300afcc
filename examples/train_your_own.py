"""Train your own torch model from an exported label file: loss times weight.

python train_your_own.py                  # labels of curate_results.py, made first if need be
python train_your_own.py labels.sqlite    # any export in the format sqlite
"""

# %% The labels
import sys
from pathlib import Path

import torch
from torch import nn
from torch.nn import functional
from torch.utils.data import DataLoader

from curate import LabelBatch, WeightedLabels

exported = Path(sys.argv[1] if len(sys.argv) > 1 else "work/exports/labels.sqlite")
if not exported.exists():
    import curate_results  # noqa: F401 - makes them

labels = WeightedLabels(exported)
loader = DataLoader(labels, batch_size=4, shuffle=True, collate_fn=labels.collate)

# %% A toy model
# It sees a grid of 2 m cells in front of the vehicle: how many points, and how high they reach.
# Of every cell it says which category stands there, and where in the cell.
CELL, COLUMNS, ROWS = 2.0, 35, 40
CORNER = torch.tensor([0.0, -ROWS * CELL / 2])
OUTPUTS = len(labels.categories) + 2


def cells(xy: torch.Tensor, frames: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the cell of each position over all frames of the batch, and which are on the grid."""
    column, row = ((xy - CORNER) // CELL).long().T
    inside = (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS)
    return ((frames * COLUMNS + column) * ROWS + row)[inside], inside


def grid(batch: LabelBatch) -> torch.Tensor:
    """Return (b, 2, COLUMNS, ROWS): log of the points in each cell, and their greatest height."""
    count = torch.zeros(len(batch.frame_ids) * COLUMNS * ROWS)
    index, inside = cells(batch.points[:, :2], batch.point_frames)
    height = torch.zeros_like(count).scatter_reduce(0, index, batch.points[inside, 2], "amax")
    count = count.index_add(0, index, torch.ones(len(index)))
    return torch.stack([count.log1p(), height]).view(2, -1, COLUMNS, ROWS).transpose(0, 1)


torch.manual_seed(0)
network = nn.Sequential(
    nn.Conv2d(2, 32, 3, padding=1), nn.ReLU(),
    nn.Conv2d(32, 32, 3, padding=1), nn.ReLU(),
    nn.Conv2d(32, OUTPUTS, 1),
)  # fmt: skip
nn.init.constant_(network[-1].bias, -3.0)  # most cells are empty
optimizer = torch.optim.Adam(network.parameters(), 3e-3)


# %% Loss times weight
# v multiplies the classification and the box loss of its object (An et al. 2023, Eqs. 6 and 10).
# Divide by a constant, never by the sum of the weights, which would cancel them. A weight of 0 is a
# region to ignore: labels of weight 0 that are background are not in the batch.
def weighted_loss(batch: LabelBatch, objects: float = 20.0) -> torch.Tensor:
    """Return the loss of a batch: weighted objects, and background where there is none."""
    output = network(grid(batch)).permute(0, 2, 3, 1).reshape(-1, OUTPUTS)
    index, inside = cells(batch.boxes[:, :2], batch.box_frames)
    wanted = torch.zeros(len(output), OUTPUTS - 2)
    weight = torch.ones(len(output))
    wanted[index, batch.categories[inside]] = (batch.weights[inside] > 0).float()
    weight[index] = batch.weights[inside]
    classify = functional.binary_cross_entropy_with_logits(
        output[:, :-2], wanted, reduction="none"
    ).sum(dim=1)
    offset = (batch.boxes[inside, :2] - CORNER) / CELL % 1
    place = functional.smooth_l1_loss(output[index, -2:], offset, reduction="none").sum(dim=1)
    return ((weight * classify).sum() + (batch.weights[inside] * place).sum()) / objects


# %% Training
for epoch in range(5):
    total = 0.0
    for batch in loader:
        loss = weighted_loss(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        total += loss.item()
    print(f"epoch {epoch + 1}: loss {total / len(loader):.3f}")
torch.save(network.state_dict(), "my_model.pt")
