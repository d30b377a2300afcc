"""ONNX Runtime sessions on the CPU for models of the user, and the errors they raise."""

from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import ModelError, first_line


def is_numeric_array(output: Any) -> bool:
    """Return whether a model's output is an array of numbers: not text, a sequence or a map."""
    return isinstance(output, np.ndarray) and output.dtype.kind in "fiub"


def open_session(model: Path, threads: int, section: str) -> Any:
    """Return an `onnxruntime.InferenceSession` for a model file.

    Args:
        model: the .onnx file.
        threads: number of threads that ONNX Runtime uses for one operator.
        section: the configuration section with the model's path, for error messages.

    Raises:
        ModelError: if the file is missing, or is not a usable ONNX model.
    """
    import onnxruntime

    if not model.is_file():
        raise ModelError(f"{model}: no such ONNX model; set {section}.path")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Spinning threads would take the cores from the other workers.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # errors are raised, so they need not be logged too
    load_errors: tuple[type[Exception], ...] = (*runtime_errors(), RuntimeError, ValueError)
    try:
        # With the fallback enabled, it would print the error and try the same provider again.
        return onnxruntime.InferenceSession(
            str(model), options, providers=["CPUExecutionProvider"], enable_fallback=0
        )
    except load_errors as error:
        raise ModelError(f"{model}: not a usable ONNX model: {first_line(error)}") from error


def runtime_errors() -> tuple[type[Exception], ...]:
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
