"""Execution providers of ONNX Runtime: on which hardware a model runs, and what if one is missing.

A provider is the part of ONNX Runtime that runs models on one kind of hardware. It works only if
the installed package of ONNX Runtime contains it and its libraries can be loaded. Where they cannot
be loaded, ONNX Runtime itself continues on the CPU without an error. So every session is compared
with what was requested.
"""

import ctypes
import io
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from multiprocessing import parent_process
from pathlib import Path
from typing import Any, Final

from curate.errors import ConfigError, first_line, one_line
from curate.files.onnx_provider_options import KNOWN_OPTIONS
from curate.spelling import did_you_mean
from curate.warnings_once import note_once, warn_once

AUTO: Final = "auto"
Providers = str | Sequence[str]
"""`AUTO`, the name of a provider, or several names in the order of preference."""
ProviderOptions = Mapping[str, Mapping[str, Any]]
"""Options of providers, by the name of the provider."""

_SUFFIX = "ExecutionProvider"
_LOG_NOTHING = 4  # errors are raised, so they need not be logged too
_REASON_LENGTH = 200  # characters of a reason that are shown; the cause is at its end


@dataclass(frozen=True)
class Provider:
    """An execution provider of ONNX Runtime.

    Attributes:
        name: its name in settings.
        runtime_name: its name in ONNX Runtime.
        package: what to install for it.
        automatic: whether `AUTO` takes it where it is installed.
        fixed_shapes: whether `AUTO` takes it only for models with inputs of fixed shapes.
        exclusive: whether workers of one machine should not share its device.
        options: options that differ from ONNX Runtime's own defaults.
    """

    name: str
    runtime_name: str
    package: str
    automatic: bool = True
    fixed_shapes: bool = False
    exclusive: bool = True
    options: Mapping[str, Any] = field(default_factory=dict)


CPU: Final = Provider("cpu", "CPUExecutionProvider", "onnxruntime", exclusive=False)
# In the order in which `AUTO` tries them. It leaves out TensorRT, which builds an engine for every
# new model and input shape; that takes minutes. NVIDIA's TensorFloat-32 and the 16 bits of Apple's
# Neural Engine are off because they change the third digit of a score. What is left are differences
# of rounding.
PROVIDERS: Final = (
    Provider(
        "cuda", "CUDAExecutionProvider", "onnxruntime-gpu[cuda,cudnn]", options={"use_tf32": 0}
    ),
    Provider(
        "tensorrt",
        "TensorrtExecutionProvider",
        "onnxruntime-gpu and NVIDIA's TensorRT",
        automatic=False,
    ),
    Provider("migraphx", "MIGraphXExecutionProvider", "onnxruntime-migraphx"),
    Provider("rocm", "ROCMExecutionProvider", "onnxruntime-rocm"),
    Provider("directml", "DmlExecutionProvider", "onnxruntime-directml"),
    Provider("openvino", "OpenVINOExecutionProvider", "onnxruntime-openvino", exclusive=False),
    Provider(
        "coreml",
        "CoreMLExecutionProvider",
        "onnxruntime on macOS",
        fixed_shapes=True,
        options={"ModelFormat": "MLProgram", "MLComputeUnits": "CPUAndGPU"},
    ),
    CPU,
)
"""The known providers."""
_OF_DEVICE = {"cuda": ("cuda", "migraphx", "rocm"), "mps": ("coreml",), "xpu": ("openvino",)}
_BY_NAME = {each.name: each for each in PROVIDERS} | {each.runtime_name: each for each in PROVIDERS}


def provider_named(name: str) -> Provider:
    """Return a provider by its name in settings or in ONNX Runtime.

    Raises:
        ConfigError: if there is no such provider.
    """
    if name in _BY_NAME:
        return _BY_NAME[name]
    if name.endswith(_SUFFIX) and name.isidentifier():
        return Provider(name, name, "a package of ONNX Runtime that contains it", automatic=False)
    raise ConfigError(
        f"unknown provider '{name}': use '{AUTO}', one of "
        f"{', '.join(each.name for each in PROVIDERS)}, or the name of another provider in ONNX "
        f"Runtime{did_you_mean(name, (AUTO, *_BY_NAME))}"
    )


def listed_providers(providers: Providers) -> tuple[Provider, ...]:
    """Return the providers that are listed explicitly; none for `AUTO`.

    Raises:
        ConfigError: if one is unknown.
    """
    names = (providers,) if isinstance(providers, str) else tuple(providers)
    return () if names == (AUTO,) else tuple(map(provider_named, names))


def installed_providers() -> tuple[Provider, ...]:
    """Return the providers in the installed package of ONNX Runtime, as `AUTO` prefers them."""
    import onnxruntime

    # The provider of Azure runs no model; it calls a service.
    names = [name for name in onnxruntime.get_available_providers() if "Azure" not in name]
    others = (provider_named(name) for name in names if name not in _BY_NAME)
    return (*(each for each in PROVIDERS if each.runtime_name in names), *others)


def requested_providers(providers: Providers) -> tuple[Provider, ...]:
    """Return the providers that a model may run on, the preferred one first.

    With `AUTO` they are the installed ones that it tries; the last one is the CPU.

    Raises:
        ConfigError: if a listed provider is unknown, or missing in the installed ONNX Runtime.
    """
    listed, installed = listed_providers(providers), installed_providers()
    for provider in listed:
        if provider not in installed:
            raise ConfigError(
                f"provider '{provider.name}' is not in the installed ONNX Runtime, which has "
                f"{', '.join(each.name for each in installed)}; install {provider.package}, or use "
                f"'{AUTO}'"
            )
    return listed or tuple(each for each in installed if each.automatic)


def providers_of_device(
    device: str, options: ProviderOptions | None = None
) -> tuple[Providers, ProviderOptions]:
    """Return the providers that run on a device of torch, and their options.

    Args:
        device: "auto", "cpu", or a device such as "cuda:1".
        options: options of the user, which come before those of the device.

    Raises:
        ConfigError: if ONNX Runtime has no provider for the device.
    """
    given = options or {}
    kind, _, number = device.partition(":")
    if kind in {AUTO, CPU.name}:
        return kind, given
    if kind not in _OF_DEVICE:
        raise ConfigError(
            f"ONNX Runtime has no provider for device '{device}'; list the providers to use"
        )
    installed = [each.name for each in installed_providers()]
    names = _OF_DEVICE[kind]
    name = next((each for each in names if each in installed), names[0])
    own: dict[str, Any] = {"device_id": int(number)} if number else {}
    if name == "openvino":
        own = {"device_type": f"GPU.{number}" if number else "GPU"}
    return (name,), {**given, name: {**own, **given.get(name, {})}}


def ignored_options(providers: Providers, options: ProviderOptions) -> Iterator[str]:
    """Yield a message for every option that ONNX Runtime would ignore, or fail on later.

    Raises:
        ConfigError: if a provider is unknown.
    """
    listed = listed_providers(providers)
    for name, values in options.items():
        provider = provider_named(name)
        if listed and provider not in listed:
            yield f"provider '{name}' is not used, so its options have no effect"
        elif not listed and not provider.automatic:
            yield f"'{AUTO}' never takes provider '{name}', so its options have no effect; list it"
        known = KNOWN_OPTIONS.get(provider.name, values)
        for key in values:
            if key not in known:
                yield f"provider '{name}' has no option '{key}'{did_you_mean(key, known)}"


def is_exclusive(providers: Providers, options: ProviderOptions | None = None) -> bool:
    """Return whether the preferred provider has a device that workers should not share."""
    provider = requested_providers(providers)[0]
    device = str(_options_of(provider, options or {}).get("device_type", "CPU"))
    return provider.exclusive or not device.startswith("CPU")


def open_session(
    path: Path,
    threads: int = 1,
    providers: Providers = CPU.name,
    options: ProviderOptions | None = None,
) -> Any:
    """Return an `onnxruntime.InferenceSession` on the providers.

    `AUTO` takes the first provider that works, and warns of those that do not. Listed providers
    must all work. Operators that a provider does not support run on the CPU.

    Args:
        path: the .onnx file.
        threads: number of threads of an operator on the CPU.
        providers: see `Providers`.
        options: see `ProviderOptions`.

    Raises:
        ConfigError: if a listed provider is unknown, not installed, or cannot be used.
        Exception: one of `runtime_errors`, if the model cannot be loaded.
    """
    requested = requested_providers(providers)
    if listed_providers(providers):
        return _open_on(path, threads, requested, options or {})
    *others, last = requested
    for provider in others:
        if provider.fixed_shapes and not _has_fixed_shapes(path):
            continue
        try:
            return _open_on(path, threads, (provider,), options or {})
        except ConfigError as error:
            if parent_process() is None:  # workers repeat what their parent has said
                warn_once(f"{error}. The model runs without it")
    return _open_on(path, threads, (last,), options or {})


def runtime_errors() -> tuple[type[Exception], ...]:
    """Return the classes of errors of ONNX Runtime; those of its own have no common base class."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    return (
        state.EPFail,
        state.Fail,
        state.InvalidArgument,
        state.InvalidGraph,
        state.InvalidProtobuf,
        state.NoSuchFile,
        state.NotImplemented,
        state.RuntimeException,
        RuntimeError,
        ValueError,
    )


def _open_on(
    path: Path, threads: int, providers: tuple[Provider, ...], options: ProviderOptions
) -> Any:
    """Return a session on all of the providers.

    Raises:
        ConfigError: if one of them cannot be used, but the model can be loaded without them.
    """
    try:
        session = _create(path, threads, providers, options)
    except runtime_errors() as error:
        if providers == (CPU,):
            raise
        _create(path, threads, (CPU,), {})  # raises if the model is at fault
        raise _unusable(path, providers[0], _shortened(error)) from error
    for provider in providers:
        if provider.runtime_name not in session.get_providers():
            reason = f"{_load_problem(provider)}; it needs {provider.package}"
            raise _unusable(path, provider, reason)
    if providers[0] != CPU:
        note_once(f"{path.name} runs on ONNX Runtime's provider '{providers[0].name}'")
    return session


def _create(
    path: Path, threads: int, providers: Sequence[Provider], options: ProviderOptions
) -> Any:
    """Return a session; it lacks the providers that cannot be loaded."""
    import onnxruntime

    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = threads
    settings.inter_op_num_threads = 1
    # Spinning threads would take the cores from the other workers.
    settings.add_session_config_entry("session.intra_op.allow_spinning", "0")
    settings.log_severity_level = _LOG_NOTHING
    if providers != (CPU,):
        onnxruntime.set_default_logger_severity(_LOG_NOTHING)
    if any(each.name in {"cuda", "tensorrt"} for each in providers):
        _load_cuda_libraries()
    return onnxruntime.InferenceSession(
        str(path),
        settings,
        providers=[(each.runtime_name, _options_of(each, options, threads)) for each in providers],
        # With the fallback enabled, it would print the error and try other providers.
        enable_fallback=0,
    )


def _options_of(provider: Provider, options: ProviderOptions, threads: int = 1) -> dict[str, Any]:
    """Return the options of a provider: its defaults, and those of the user on top."""
    own = {"num_of_threads": threads} if provider.name == "openvino" else {}
    given = [values for name, values in options.items() if provider_named(name) == provider]
    return {**own, **provider.options, **(given[0] if given else {})}


def _load_cuda_libraries() -> None:
    """Load the libraries of CUDA from the packages of pip, as they are on no search path."""
    import onnxruntime

    # Its messages are left out: what is missing is found when the provider is loaded.
    if hasattr(onnxruntime, "preload_dlls"):  # since 1.21
        with redirect_stdout(io.StringIO()):
            onnxruntime.preload_dlls()


def _has_fixed_shapes(path: Path) -> bool:
    """Return whether all axes of a model's inputs have a declared size."""
    inputs = _create(path, 1, (CPU,), {}).get_inputs()
    return all(isinstance(size, int) for each in inputs for size in each.shape)


def _unusable(path: Path, provider: Provider, reason: str) -> ConfigError:
    return ConfigError(f"{path}: provider '{provider.name}' cannot be used: {reason}")


def _load_problem(provider: Provider) -> str:
    """Return why the library of a provider cannot be loaded; ONNX Runtime does not report it."""
    import onnxruntime

    folder = Path(onnxruntime.__file__).parent / "capi"
    suffix = "dylib" if sys.platform == "darwin" else "so"
    kind = provider.runtime_name.removesuffix(_SUFFIX).lower()
    libraries = [folder / f"libonnxruntime_providers_{name}.{suffix}" for name in ("shared", kind)]
    try:
        for library in libraries:
            if library.exists():
                ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    except OSError as error:
        return first_line(error)
    return "it found no device that it can use"


def _shortened(error: BaseException) -> str:
    """Return the end of an error message of ONNX Runtime, which has the cause, on one line."""
    text = one_line(error)
    return text if len(text) <= _REASON_LENGTH else f"...{text[-_REASON_LENGTH:]}"
