"""Files on which a library in C++ ends the process, and readers that do so."""

import os
import signal
import time
from pathlib import Path

import numpy as np


def read_nothing(path: Path) -> None:
    """Read a file in Python."""
    path.read_bytes()


def fail(path: Path) -> None:
    """Raise an ordinary error."""
    raise ValueError(path)


def abort(path: Path) -> None:
    """End the process with a message, as std::terminate does."""
    os.write(2, f"terminate called\n  what():  {path.read_text()}\n".encode())
    os.abort()


def leave(path: Path) -> None:
    """End the process with an exit code, as exit() in a library does."""
    os._exit(len(path.read_bytes()))


def hang(path: Path) -> None:
    """Take forever."""
    path.read_bytes()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(1000)


def talk(path: Path) -> None:
    """Write more to both outputs than a pipe holds."""
    for _ in range(40):
        os.write(1, path.read_bytes() * 10_000)
        os.write(2, path.read_bytes() * 10_000)


def count(path: Path) -> None:
    """Leave a trace of each call beside the file."""
    with path.with_suffix(".calls").open("a") as calls:
        calls.write("x")


def write_aborting_parquet(path: Path) -> None:
    """Write a record for which pyarrow 25 aborts: column y is neither required nor optional."""
    from fuzzing.foreign_formats import write_parquet

    write_parquet(path)
    content = path.read_bytes()
    optional, damaged = b"\x25\x02\x18\x01y", b"\x25\x03\x18\x01y"
    if content.count(optional) != 1:
        raise AssertionError("pyarrow writes another header")
    path.write_bytes(content.replace(optional, damaged))


def write_overflowing_model(path: Path, *, early: bool = False) -> None:
    """Write a model of points with an integer division that the processor answers with SIGFPE.

    Args:
        path: of the .onnx file.
        early: whether already loading the model divides, instead of the first run.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    constants = {
        "lowest": np.array([-(2**31)], np.int32),
        "minus one": np.array([-1], np.int32),
        "zero": np.array([0.0], np.float32),
    }
    divided = "lowest" if early else "dividend"
    nodes = [
        helper.make_node("ReduceSum", ["points"], ["sum"], keepdims=0),
        helper.make_node("Mul", ["sum", "zero"], ["nothing"]),
        helper.make_node("Cast", ["nothing"], ["whole"], to=TensorProto.INT32),
        helper.make_node("Add", ["whole", "lowest"], ["dividend"]),
        helper.make_node("Div", [divided, "minus one"], ["labels"]),
        helper.make_node("Cast", ["labels"], ["scores"], to=TensorProto.FLOAT),
        helper.make_node("Identity", ["points"], ["boxes"]),
    ]
    outputs = [
        helper.make_tensor_value_info("boxes", TensorProto.FLOAT, ("n", 4)),
        helper.make_tensor_value_info("scores", TensorProto.FLOAT, (1,)),
        helper.make_tensor_value_info("labels", TensorProto.INT32, (1,)),
    ]
    graph = helper.make_graph(
        nodes,
        "overflowing",
        [helper.make_tensor_value_info("points", TensorProto.FLOAT, ("n", 4))],
        outputs,
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.save(model, str(path))
