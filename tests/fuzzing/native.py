"""Damage that gets past the checksums and parsers of formats that libraries in C++ read."""

import struct
import zlib

import onnx
from fuzzing.mutations import Choose, mutated
from google.protobuf.message import DecodeError
from onnx import AttributeProto, ModelProto

_SIGNATURE_BYTES = 8
_CHUNK = struct.Struct(">I4s")
_SIZES = (-(2**63), -(2**31), -2, -1, 0, 1, 2, 3, 7, 255, 65536, 2**31 - 1, 2**31, 2**40, 2**63 - 1)
_FLOATS = (float("nan"), float("inf"), -1e38, -1.0, 0.0, 1e-40, 1e38)
_OPERATORS = (
    "Abs", "Add", "ArgMax", "AveragePool", "Cast", "Clip", "Concat", "ConstantOfShape", "Conv",
    "CumSum", "DepthToSpace", "Div", "Equal", "Expand", "Flatten", "Gather", "GatherND", "Gemm",
    "Identity", "InstanceNormalization", "LRN", "MatMul", "MaxPool", "Mod", "NonMaxSuppression",
    "NonZero", "OneHot", "Pad", "Pow", "Range", "ReduceMax", "ReduceMean", "Reshape", "Resize",
    "RoiAlign", "ScatterElements", "ScatterND", "Shape", "Slice", "Softmax", "SpaceToDepth",
    "Split", "Squeeze", "Tile", "TopK", "Transpose", "Unsqueeze", "Where",
)  # fmt: skip


def damaged_png(content: bytes, choose: Choose) -> bytes:
    """Return a damaged PNG; mostly with the checksums of its damaged chunks, or of its pixels."""
    kind = choose(0, 3)
    if kind == 0:
        return mutated(content, choose)
    parts = [content[:_SIGNATURE_BYTES]]
    for name, part in _chunks(content):
        if kind == 1 or (kind == 2 and name == b"IDAT"):
            written = _pixels_damaged(part, choose) if name == b"IDAT" else part
            written = mutated(written, choose) if name != b"IDAT" and choose(0, 2) == 0 else written
        else:
            written = mutated(part, choose) if choose(0, 3) == 0 else part
        checksum = struct.pack(">I", zlib.crc32(name + written))
        parts += [_CHUNK.pack(len(written), name), written, checksum]
    return b"".join(parts)


def _chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    found, offset = [], _SIGNATURE_BYTES
    while offset + _CHUNK.size <= len(content):
        length, name = _CHUNK.unpack_from(content, offset)
        offset += _CHUNK.size
        found.append((name, content[offset : offset + length]))
        offset += length + 4
    return found


def _pixels_damaged(packed: bytes, choose: Choose) -> bytes:
    """Return the compressed form of damaged pixels and filters."""
    return zlib.compress(mutated(zlib.decompress(packed), choose), choose(0, 9))


def damaged_onnx(content: bytes, choose: Choose) -> bytes:
    """Return a damaged model; mostly one that protobuf still reads."""
    if choose(0, 3) == 0:
        return mutated(content, choose)
    try:
        model = onnx.load_model_from_string(content)
        for _ in range(choose(1, 4)):
            _DAMAGES[choose(0, len(_DAMAGES) - 1)](model, choose)
        written: bytes = model.SerializeToString()
    except (DecodeError, ValueError, IndexError):
        return mutated(content, choose)
    return written


def _one(items, choose: Choose):
    return items[choose(0, len(items) - 1)]


def _operator_changed(model: ModelProto, choose: Choose) -> None:
    _one(model.graph.node, choose).op_type = _one(_OPERATORS, choose)


def _attribute_changed(model: ModelProto, choose: Choose) -> None:
    node = _one(model.graph.node, choose)
    if not node.attribute:
        names = ("axis", "to", "kernel_shape", "strides", "pads", "group", "keepdims", "axes")
        value = [_one(_SIZES, choose) for _ in range(choose(1, 4))]
        node.attribute.append(onnx.helper.make_attribute(_one(names, choose), value))
        return
    attribute = _one(node.attribute, choose)
    if attribute.type == AttributeProto.INT:
        attribute.i = _one(_SIZES, choose)
    elif attribute.type == AttributeProto.FLOAT:
        attribute.f = _one(_FLOATS, choose)
    elif attribute.ints:
        attribute.ints[choose(0, len(attribute.ints) - 1)] = _one(_SIZES, choose)
    elif attribute.HasField("t"):
        _tensor_changed(attribute.t, choose)


def _constant_changed(model: ModelProto, choose: Choose) -> None:
    _tensor_changed(_one(model.graph.initializer, choose), choose)


def _tensor_changed(tensor, choose: Choose) -> None:
    kind = choose(0, 3)
    if kind == 0:
        tensor.data_type = choose(0, 20)
    elif kind == 1 and tensor.dims:
        tensor.dims[choose(0, len(tensor.dims) - 1)] = _one(_SIZES, choose)
    elif kind == 2 and len(tensor.raw_data) >= 8:
        at = choose(0, len(tensor.raw_data) // 8 - 1) * 8
        number = struct.pack("<q", _one(_SIZES, choose))
        tensor.raw_data = tensor.raw_data[:at] + number + tensor.raw_data[at + 8 :]
    else:
        tensor.raw_data = mutated(tensor.raw_data, choose)


def _shape_changed(model: ModelProto, choose: Choose) -> None:
    value = _one([*model.graph.input, *model.graph.output], choose)
    value.type.tensor_type.elem_type = choose(0, 20) if choose(0, 2) == 0 else 1
    sizes = value.type.tensor_type.shape.dim
    if sizes:
        _one(sizes, choose).dim_value = _one(_SIZES, choose)


def _input_rewired(model: ModelProto, choose: Choose) -> None:
    node = _one(model.graph.node, choose)
    names = [name for other in model.graph.node for name in (*other.input, *other.output)]
    if node.input:
        node.input[choose(0, len(node.input) - 1)] = _one(names, choose)


_DAMAGES = (
    _operator_changed,
    _attribute_changed,
    _constant_changed,
    _shape_changed,
    _input_rewired,
)
