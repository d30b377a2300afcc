"""Sessions of ONNX Runtime on the CPU for models that users bring, and their errors."""

from pathlib import Path
from typing import Any

import numpy as np

from curate.errors import ModelError, first_line


def are_numbers(answer: Any) -> bool:
    """Whether a model's answer is an array of numbers, not of text, nor a sequence or a map."""
    return isinstance(answer, np.ndarray) and answer.dtype.kind in "fiub"


def open_session(model: Path, threads: int, section: str) -> Any:
    """Return a session.

    Args:
        model: the .onnx file.
        threads: of ONNX Runtime.
        section: of the configuration that names the model, for messages.

    Raises:
        ModelError: if the file is missing or no usable ONNX model.
    """
    import onnxruntime

    if not model.is_file():
        raise ModelError(f"{model}: no such ONNX model; set {section}.path")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Waiting threads would take the cores from the other workers.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 4  # what is an error is raised, and need not be printed too
    refusals: tuple[type[Exception], ...] = (*runtime_errors(), RuntimeError, ValueError)
    try:
        # With its fallback, it would print what is wrong and try the same provider again.
        return onnxruntime.InferenceSession(
            str(model), options, providers=["CPUExecutionProvider"], enable_fallback=0
        )
    except refusals as error:
        raise ModelError(f"{model}: no usable ONNX model: {first_line(error)}") from error


def runtime_errors() -> tuple[type[Exception], ...]:
    """What ONNX Runtime raises; its errors have no common root of their own."""
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
