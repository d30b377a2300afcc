"""Mixed precision: the type of numbers in which a network computes on a device."""

from typing import TYPE_CHECKING, Final, Literal, get_args

from curate.errors import ConfigError, first_line

if TYPE_CHECKING:
    import torch

Precision = Literal["float32", "float16", "bfloat16"]
FLOAT32: Final = "float32"


def mixed_precision(precision: Precision, device: str) -> "torch.autocast":
    """Return a context in which torch computes with a precision; weights stay float32.

    Raises:
        ConfigError: if there is no such precision, or the device does not have it.
    """
    import torch

    if precision not in get_args(Precision):
        choices = ", ".join(get_args(Precision))
        raise ConfigError(f"unknown precision {precision!r}; choose one of {choices}")
    kind, dtype = torch.device(device).type, getattr(torch, precision)
    if precision == FLOAT32:
        return torch.autocast("cpu", enabled=False)
    try:
        return torch.autocast(kind, dtype=dtype)
    except RuntimeError as error:
        raise ConfigError(
            f"precision {precision!r} cannot be used on {device}: {first_line(error)}"
        ) from None
