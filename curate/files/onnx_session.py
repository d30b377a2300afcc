"""ONNX models of the user in ONNX Runtime."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import ModelError, error_prefix, first_line
from curate.files.child_process import require_survival
from curate.files.onnx_providers import (
    AUTO,
    ProviderOptions,
    Providers,
    open_session,
    runtime_errors,
)

_LIBRARY = "onnxruntime"


@dataclass(frozen=True)
class ModelValue:
    """An input or output as the model declares it.

    Attributes:
        name: its name.
        type: e.g. "tensor(float)".
        shape: a number, a name or None per axis; the last two are free. Empty if not declared.
    """

    name: str
    type: str
    shape: tuple[int | str | None, ...]

    def __str__(self) -> str:
        axes = ", ".join("?" if size is None else str(size) for size in self.shape)
        return f"{self.name} {self.type}[{axes}]"


class OnnxModel:
    """An ONNX model that can be run.

    Its file is loaded, and run for the first time, by a child process first, on the CPU: ONNX
    Runtime ends the process on some damaged models.

    Args:
        path: the .onnx file.
        threads: number of threads that ONNX Runtime uses for one operator on the CPU.
        section: the configuration section with the model's path, for error messages.
        providers: where the model runs, see `curate.files.onnx_providers`.
        provider_options: options of the providers.

    Attributes:
        path: the .onnx file.
        inputs: the declared inputs.
        outputs: the declared outputs.

    Raises:
        ModelError: if the file is missing, or is not a usable ONNX model.
        ConfigError: if a listed provider cannot be used.
    """

    def __init__(
        self,
        path: Path,
        threads: int,
        section: str,
        providers: Providers = AUTO,
        provider_options: ProviderOptions | None = None,
    ) -> None:
        if not path.is_file():
            raise ModelError(f"{path}: no such ONNX model; set {section}.path")
        self.path = path
        require_survival(path, _LIBRARY, open_session, error=ModelError)
        try:
            with error_prefix(f"{section}.providers"):
                self._session = open_session(path, threads, providers, provider_options)
            self.inputs = _declared(self._session.get_inputs())
            self.outputs = _declared(self._session.get_outputs())
        except runtime_errors() as error:
            raise ModelError(f"{path}: not a usable ONNX model: {first_line(error)}") from error

    def run(
        self, inputs: Mapping[str, np.ndarray], outputs: Sequence[str] | None = None
    ) -> dict[str, Any]:
        """Return the values of the named outputs, or of all, by name.

        Raises:
            ModelError: if the model fails.
        """
        names = [output.name for output in self.outputs] if outputs is None else list(outputs)
        require_survival(self.path, _LIBRARY, _run_once, names, dict(inputs), error=ModelError)
        try:
            return dict(zip(names, self._session.run(names, dict(inputs)), strict=True))
        except runtime_errors() as error:
            raise ModelError(f"{self.path}: {first_line(error)}") from error


def is_numeric_array(output: Any) -> bool:
    """Return whether a model's output is an array of numbers: not text, a sequence or a map."""
    return isinstance(output, np.ndarray) and output.dtype.kind in "fiub"


def without_batch(values: np.ndarray, axes: int) -> np.ndarray:
    """Return values of that many axes without a leading batch axis of length 1."""
    return values[0] if values.ndim == axes + 1 and len(values) == 1 else values


def _declared(values: Sequence[Any]) -> tuple[ModelValue, ...]:
    return tuple(ModelValue(value.name, value.type, tuple(value.shape or ())) for value in values)


def _run_once(path: Path, names: Sequence[str], inputs: Mapping[str, np.ndarray]) -> None:
    """Load a model and run it; called in a child process."""
    open_session(path).run(list(names), dict(inputs))
