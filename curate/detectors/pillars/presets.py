"""The two sizes of the pillar detector: what it sees, in which grid, with how many channels."""

from dataclasses import dataclass
from typing import Final

from curate.errors import ConfigError


@dataclass(frozen=True)
class Preset:
    """A grid over the ground and a network that fits it.

    Attributes:
        name: as in the configuration.
        pillar_m: edge of a pillar in metres.
        x_range: lowest and highest x in metres in the LiDAR frame.
        y_range: lowest and highest y.
        height_range: lowest and highest points that are looked at, in metres above the ground.
        pillar_channels: of the point network.
        channels: of the three scales; the first is at two pillars per cell.
        depths: convolutions per scale, after the one that goes down to it.
        head_channels: of the map from which the answers are read.
    """

    name: str
    pillar_m: float
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    height_range: tuple[float, float]
    pillar_channels: int
    channels: tuple[int, int, int]
    depths: tuple[int, int, int]
    head_channels: int

    @property
    def cell_m(self) -> float:
        """Edge of an output cell in metres."""
        return 2 * self.pillar_m

    @property
    def cells(self) -> tuple[int, int]:
        """(along x, along y) output cells; both divisible by 4."""
        return (
            round((self.x_range[1] - self.x_range[0]) / self.cell_m),
            round((self.y_range[1] - self.y_range[0]) / self.cell_m),
        )


PRESETS: Final = {
    preset.name: preset
    for preset in (
        Preset(
            "small", 0.32, (0.0, 51.2), (-32.0, 32.0), (-1.0, 4.0), 16, (32, 48, 96), (1, 2, 2), 32
        ),
        Preset(
            "kitti", 0.16, (0.0, 69.12), (-39.68, 39.68), (-1.0, 4.0), 32, (64, 128, 256),
            (2, 4, 4), 64,
        ),
    )
}  # fmt: skip


def preset_named(name: str) -> Preset:
    """Return the preset of that name.

    Raises:
        ConfigError: if there is none.
    """
    try:
        return PRESETS[name]
    except KeyError:
        raise ConfigError(f"unknown preset {name!r}; choose one of {', '.join(PRESETS)}") from None
