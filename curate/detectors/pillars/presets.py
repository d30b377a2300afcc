"""Presets of the pillar detector: range, grid and size of the network."""

from dataclasses import dataclass
from typing import Final

from curate.errors import ConfigError


@dataclass(frozen=True)
class Preset:
    """A BEV grid and a network of matching size.

    Attributes:
        name: name in the configuration.
        pillar_m: edge of a pillar in metres.
        x_range: lowest and highest x in metres in the LiDAR frame.
        y_range: lowest and highest y in metres in the LiDAR frame.
        height_range: lowest and highest z of the points that are used, in metres above the ground.
        pillar_channels: channels of the point network.
        channels: channels of the three scales; a cell of the first scale covers 2 x 2 pillars.
        depths: convolutions per scale, not counting the one that downsamples to it.
        head_channels: channels of the map from which the outputs are computed.
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
        """Number of output cells along x and along y; both divisible by 4."""
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
        ConfigError: if there is no such preset.
    """
    try:
        return PRESETS[name]
    except KeyError:
        raise ConfigError(f"unknown preset {name!r}; choose one of {', '.join(PRESETS)}") from None
