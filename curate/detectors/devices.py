"""Devices of torch: their names, and which of them can be used."""

import re
from importlib.metadata import version
from typing import Final

from curate.errors import ConfigError, first_line
from curate.spelling import did_you_mean

AUTO: Final = "auto"
_REASON_LENGTH = 120  # characters of a reason that are shown
_COMMON = (AUTO, "cpu", "cuda", "mps", "xpu")
# Names of torch's backends of other vendors; some are known to torch only with their package.
_OTHERS = ("hpu", "mlu", "mtia", "musa", "npu", "privateuseone", "xla")


def check_device_name(name: str) -> None:
    """Check the form of a device's name, without torch.

    Raises:
        ConfigError: if it is not "auto" or a device of torch, with or without a number.
    """
    match = re.fullmatch(r"([a-z]+)(:\d+)?", name)
    if match is None or match[1] not in (*_COMMON, *_OTHERS) or name.startswith(f"{AUTO}:"):
        meant = "; did you mean 'cuda'?" if name == "gpu" else did_you_mean(name, _COMMON)
        raise ConfigError(
            f"unknown device '{name}': use {', '.join(_COMMON)} or another device of torch, with "
            f"a number for one of several, such as cuda:1{meant}"
        )


def choose_device(name: str) -> str:
    """Return the device with this name; for "auto", torch's accelerator or else "cpu"."""
    if name != AUTO:
        return name
    if version("torch").endswith("+cpu"):  # importing torch takes a second
        return "cpu"
    import torch

    accelerator = torch.accelerator.current_accelerator()
    if accelerator is None or not torch.accelerator.is_available():
        return "cpu"
    return accelerator.type


def check_device(name: str) -> None:
    """Check that torch can use a device.

    Raises:
        ConfigError: if it cannot; the message has the reason.
    """
    if name in {AUTO, "cpu"}:
        return
    import torch

    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError, ImportError) as error:
        raise ConfigError(
            f"device {name!r} cannot be used by torch {torch.__version__}: "
            f"{first_line(error)[:_REASON_LENGTH]}; install a build of torch for it, or use 'auto'"
        ) from None
