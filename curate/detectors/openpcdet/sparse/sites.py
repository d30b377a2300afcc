"""The occupied cells of a sparse 3D grid."""

from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

# Free cells behind the last cell of each axis: kernels of up to 2 * HALO + 1 cells do not reach
# from one row of the grid into the next.
HALO = 3

Triple = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Sites:
    """The occupied cells of a grid for a batch of frames, sorted by frame, z, y, x.

    Attributes:
        keys: (n,) int64, ascending; the cell's number in a grid with `HALO` free cells behind each
            axis, counted along x first.
        shape: cells along z, y, x.
        frames: number of frames.
        rulebooks: the rulebooks of these sites that were computed already, by kernel; see
            `rulebook.py`.
    """

    keys: Tensor
    shape: Triple
    frames: int
    rulebooks: dict[object, object] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, places: Tensor, shape: Triple, frames: int) -> "tuple[Sites, Tensor]":
        """Return the sites of unsorted cells, and the order in which their rows have to be put.

        Args:
            places: (n, 4) integers frame, z, y, x; no cell twice.
            shape: cells along z, y, x.
            frames: number of frames.
        """
        pitches = torch.tensor(key_pitches(shape), device=places.device)
        keys, order = torch.sort((places.long() * pitches).sum(dim=1))
        return cls(keys, shape, frames), order

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def pitches(self) -> tuple[int, int, int, int]:
        """Steps of a key along frame, z, y and x."""
        return key_pitches(self.shape)

    @cached_property
    def places(self) -> Tensor:
        """(n, 4) int64 frame, z, y, x of each cell."""
        rest, columns = self.keys, []
        for pitch in self.pitches:
            columns.append(rest // pitch)
            rest = rest % pitch
        return torch.stack(columns, dim=1)

    def same(self, other: "Sites") -> bool:
        """Return whether the other sites are the same cells of the same grid."""
        return self is other or (
            self.shape == other.shape
            and self.frames == other.frames
            and torch.equal(self.keys, other.keys)
        )


def key_pitches(shape: Triple) -> tuple[int, int, int, int]:
    """Return the steps of a key along frame, z, y and x, for cells along z, y, x."""
    height, depth, width = (size + HALO for size in shape)
    return height * depth * width, depth * width, width, 1
