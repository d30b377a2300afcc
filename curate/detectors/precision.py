"""Mixed precision: the type of numbers in which a network computes on a device."""

import warnings
from multiprocessing import parent_process
from typing import TYPE_CHECKING, Final, Literal, get_args

from curate.errors import ConfigError, first_line
from curate.warnings_once import warn_once

if TYPE_CHECKING:
    import torch

Precision = Literal["float32", "float16", "bfloat16"]
FLOAT32: Final = "float32"


def mixed_precision(precision: Precision, device: str) -> "torch.autocast":
    """Return a context in which torch computes with a precision; weights stay float32.

    It warns once of float16 on the CPU, which has no fast operators for it.

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
    # Processes of a training and workers repeat what their parent has said.
    if (kind, precision) == ("cpu", "float16") and parent_process() is None:
        warn_once(
            "precision 'float16' is many times slower than 'float32' on the CPU; set 'bfloat16', "
            "or use a GPU"
        )
    try:
        with warnings.catch_warnings():
            # torch would only warn of a type that a device lacks, and compute in float32.
            warnings.simplefilter("error")
            return torch.autocast(kind, dtype=dtype)
    except (RuntimeError, UserWarning) as error:
        raise ConfigError(
            f"precision {precision!r} cannot be used on {device}: {first_line(error)}"
        ) from None
