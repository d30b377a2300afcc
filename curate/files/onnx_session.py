"""ONNX models of the user in ONNX Runtime on the CPU."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import ModelError, first_line
from curate.files.child_process import require_survival

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

    Its file is loaded, and run for the first time, by a child process first: ONNX Runtime ends the
    process on some damaged models.

    Args:
        path: the .onnx file.
        threads: number of threads that ONNX Runtime uses for one operator.
        section: the configuration section with the model's path, for error messages.

    Attributes:
        path: the .onnx file.
        inputs: the declared inputs.
        outputs: the declared outputs.

    Raises:
        ModelError: if the file is missing, or is not a usable ONNX model.
    """

    def __init__(self, path: Path, threads: int, section: str) -> None:
        if not path.is_file():
            raise ModelError(f"{path}: no such ONNX model; set {section}.path")
        self.path = path
        require_survival(path, _LIBRARY, _open_session, error=ModelError)
        load_errors: tuple[type[Exception], ...] = (*_runtime_errors(), RuntimeError, ValueError)
        try:
            self._session = _open_session(path, threads)
            self.inputs = _declared(self._session.get_inputs())
            self.outputs = _declared(self._session.get_outputs())
        except load_errors as error:
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
        except _runtime_errors() as error:
            raise ModelError(f"{self.path}: {first_line(error)}") from error


def is_numeric_array(output: Any) -> bool:
    """Return whether a model's output is an array of numbers: not text, a sequence or a map."""
    return isinstance(output, np.ndarray) and output.dtype.kind in "fiub"


def without_batch(values: np.ndarray, axes: int) -> np.ndarray:
    """Return values of that many axes without a leading batch axis of length 1."""
    return values[0] if values.ndim == axes + 1 and len(values) == 1 else values


def _declared(values: Sequence[Any]) -> tuple[ModelValue, ...]:
    return tuple(ModelValue(value.name, value.type, tuple(value.shape or ())) for value in values)


def _open_session(path: Path, threads: int = 1) -> Any:
    """Return an `onnxruntime.InferenceSession`."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Spinning threads would take the cores from the other workers.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # errors are raised, so they need not be logged too
    # With the fallback enabled, it would print the error and try the same provider again.
    return onnxruntime.InferenceSession(
        str(path), options, providers=["CPUExecutionProvider"], enable_fallback=0
    )


def _run_once(path: Path, names: Sequence[str], inputs: Mapping[str, np.ndarray]) -> None:
    """Load a model and run it; called in a child process."""
    _open_session(path).run(list(names), dict(inputs))


def _runtime_errors() -> tuple[type[Exception], ...]:
    """Return the error classes of ONNX Runtime; they have no common base class."""
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
    )
