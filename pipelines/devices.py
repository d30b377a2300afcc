"""Where the models of a configuration run: one rule for models in torch and in ONNX Runtime.

- A detector in torch runs on `detector.device`, and is trained there.
- A model in ONNX Runtime runs on the listed `providers`. A detector without a list runs on those of
  `detector.device`.
- A detector that can run in both, such as pillars, runs in torch on a GPU and in ONNX Runtime on
  the CPU. Listed providers choose ONNX Runtime.
"""

import shutil
from dataclasses import dataclass, field
from functools import partial

from curate.detectors.devices import AUTO, check_device, choose_device
from curate.detectors.precision import FLOAT32, mixed_precision
from curate.errors import ConfigError, error_prefix
from curate.files.onnx_providers import (
    CPU,
    ProviderOptions,
    Providers,
    ignored_options,
    is_exclusive,
    providers_of_device,
    requested_providers,
)
from curate.warnings_once import warn_once
from pipelines import registry
from pipelines.workspace.config import Config

_NOT_IN_RUNTIME = "the configured class does not run in ONNX Runtime; remove the setting"


@dataclass(frozen=True)
class ModelPlace:
    """Where a model runs.

    Attributes:
        device: its device of torch; None if it runs in ONNX Runtime.
        providers: its providers of ONNX Runtime.
        options: options of the providers.
    """

    device: str | None = None
    providers: Providers = AUTO
    options: ProviderOptions = field(default_factory=dict)

    @property
    def exclusive(self) -> bool:
        """Whether the device is one that several workers should not share."""
        if self.device is not None:
            return self.device != CPU.name
        return is_exclusive(self.providers, self.options)

    @property
    def hardware(self) -> str:
        """The device of torch, or the name of the preferred provider of ONNX Runtime."""
        return self.device or requested_providers(self.providers)[0].name

    def __str__(self) -> str:
        if self.device is not None:
            return f"torch on {self.device}"
        names = [each.name for each in requested_providers(self.providers)]
        return f"ONNX Runtime on {', or '.join(names)}"


def detector_place(config: Config) -> ModelPlace | None:
    """Return where the detector predicts; None if it runs no model that curate knows of.

    Raises:
        ConfigError: if ONNX Runtime has no provider for the device.
    """
    section = config.detector
    in_torch, in_runtime = (
        registry.DETECTORS.takes(section.name, argument) for argument in ("device", "providers")
    )
    if in_runtime and section.providers != AUTO:
        return ModelPlace(providers=section.providers, options=section.provider_options or {})
    if in_torch:
        device = choose_device(section.device)
        in_runtime = in_runtime and device == CPU.name and section.precision == FLOAT32
        return ModelPlace(providers=CPU.name) if in_runtime else ModelPlace(device)
    if in_runtime:
        with error_prefix("detector.device"):
            found = providers_of_device(section.device, section.provider_options or {})
            return ModelPlace(None, *found)
    return None


def segmenter_place(config: Config) -> ModelPlace | None:
    """Return where the segmenter runs; None if it runs no model that curate knows of."""
    section = config.segmenter
    name = "onnx" if section.name == "simulated" else section.name
    if name == "none" or not registry.SEGMENTERS.takes(name, "providers"):
        return None
    return ModelPlace(providers=section.providers, options=section.provider_options or {})


def check_detector_place(config: Config) -> None:
    """Check that the detector can run where it is to run, without loading it.

    Raises:
        ConfigError: if the device or a listed provider cannot be used, or has no effect.
    """
    section = config.detector
    takes = partial(registry.DETECTORS.takes, section.name)
    if takes("device"):
        with error_prefix("detector.device"):
            check_device(section.device)
    place = detector_place(config)
    if section.precision != FLOAT32:
        if place is None or place.device is None or not takes("precision"):
            raise ConfigError(
                "detector.precision: only pillars and classes with this argument, in torch, have a "
                "mixed precision; remove the setting"
            )
        with error_prefix("detector.precision"):
            mixed_precision(section.precision, place.device)
    setting = "device" if section.providers == AUTO else "providers"
    with error_prefix(f"detector.{setting}"):
        _check_providers(place, section.providers)
    with error_prefix("detector.provider_options"):
        _check_options("detector", place, section.provider_options or {})


def check_segmenter_place(config: Config) -> None:
    """Check that the segmenter can run where it is to run, without loading it.

    Raises:
        ConfigError: if a listed provider cannot be used, or has no effect.
    """
    section, place = config.segmenter, segmenter_place(config)
    with error_prefix("segmenter.providers"):
        _check_providers(place, section.providers)
    with error_prefix("segmenter.provider_options"):
        _check_options("segmenter", place, section.provider_options or {})


def _check_options(section: str, place: ModelPlace | None, options: ProviderOptions) -> None:
    """Warn of options of providers that would be ignored, or that ONNX Runtime does not know.

    A later version may know them.

    Raises:
        ConfigError: if the configured class runs no model in ONNX Runtime.
    """
    if not options:
        return
    if place is None:
        raise ConfigError(_NOT_IN_RUNTIME)
    if place.device is not None:
        warn_once(f"{section}.provider_options have no effect: the model runs in {place}")
    else:
        for problem in ignored_options(place.providers, options):
            warn_once(f"{section}.provider_options: {problem}")


def idle_gpu(*places: ModelPlace | None) -> bool:
    """Return whether this machine has a GPU of NVIDIA, and no model uses it."""
    used = any(place.exclusive for place in places if place)
    return not used and any(places) and shutil.which("nvidia-smi") is not None


def _check_providers(place: ModelPlace | None, listed: Providers) -> None:
    """Raise ConfigError if listed providers have no effect, or one is not installed."""
    if listed != AUTO and (place is None or place.device is not None):
        raise ConfigError(_NOT_IN_RUNTIME)
    if place and place.device is None and place.providers not in (AUTO, CPU.name):
        requested_providers(place.providers)
