"""Export of the trained segmentation network to an ONNX graph, node by node.

Batch norms are folded into the preceding convolutions. The general exporter of torch would need two
more packages for this one network.
"""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto, TensorProto, helper

from curate.files.onnx_graph import EPSILON, GraphBuilder


def build_graph(weights: Mapping[str, np.ndarray], width: int, height: int) -> ModelProto:
    """Return the ONNX model of a `segmentation.SegmentationNet`.

    Its input is `image` (1, height, width, 3) uint8 RGB; its output is `class_ids` (1, height,
    width) uint8.

    Args:
        weights: the state dict of the network.
        width: width of the input in pixels.
        height: height of the input in pixels.
    """
    graph = _Graph(weights)
    sharp = graph.convolution(graph.image("image"), "sharp")
    fine = graph.convolution(sharp, "fine", stride=2)
    middle = graph.residual(graph.convolution(fine, "middle.0", stride=2), "middle.1", 1)
    deep = graph.convolution(middle, "deep.0", stride=2)
    deep = graph.residual(graph.residual(deep, "deep.1", 2), "deep.2", 4)
    for below, above, level in (
        ("deep", middle, "middle"), ("middle", fine, "fine"), ("fine", sharp, "sharp"),
    ):  # fmt: skip
        deep = graph.upsampled(graph.pointwise(deep, f"{below}_to_{level}"), above)
        deep = graph.convolution(graph.node("Add", above, deep), f"mix_{level}")
    graph.class_ids(graph.pointwise(deep, "head"), "class_ids")
    return graph.model((1, height, width))


class _Graph(GraphBuilder):
    """Builds the parts of the network; methods return the name of the value that they add."""

    def image(self, name: str) -> str:
        """Add the conversion of the input to (1, 3, height, width) values from -1 to 1."""
        pixels = self.node("Cast", name, to=TensorProto.FLOAT)
        maps = self.node("Transpose", pixels, perm=[0, 3, 1, 2])
        half, one = (self.constant(np.array(value, np.float32)) for value in (127.5, 1.0))
        return self.node("Sub", self.node("Div", maps, half), one)

    def convolution(self, maps: str, name: str, *, stride: int = 1, dilation: int = 1) -> str:
        """Add a 3 x 3 convolution with its folded batch norm, and a ReLU."""
        mean, variance = (self._weights[f"{name}.1.running_{part}"] for part in ("mean", "var"))
        scale = self._weights[f"{name}.1.weight"] / np.sqrt(variance + EPSILON)
        kernel = self.constant(self._weights[f"{name}.0.weight"] * scale[:, None, None, None])
        shift = self.constant(self._weights[f"{name}.1.bias"] - mean * scale)
        attributes = {"pads": [dilation] * 4, "strides": [stride] * 2, "dilations": [dilation] * 2}
        return self.node("Relu", self.node("Conv", maps, kernel, shift, **attributes))

    def residual(self, maps: str, name: str, dilation: int) -> str:
        """Add a residual block of two convolutions."""
        body = self.convolution(maps, f"{name}.body.0")
        return self.node("Add", maps, self.convolution(body, f"{name}.body.1", dilation=dilation))

    def pointwise(self, maps: str, name: str) -> str:
        """Add a 1 x 1 convolution with a bias, without activation."""
        parts = (self._weights[f"{name}.{part}"] for part in ("weight", "bias"))
        return self.node("Conv", maps, *map(self.constant, parts))

    def upsampled(self, maps: str, like: str) -> str:
        """Add a bilinear interpolation of `maps` to the height and width of `like`."""
        size = self.node("Shape", like, start=2)
        channels = self.node("Shape", maps, end=2)
        sizes = self.node("Concat", channels, size, axis=0)
        modes = {"mode": "linear", "coordinate_transformation_mode": "half_pixel"}
        return self.node("Resize", maps, "", "", sizes, **modes)

    def class_ids(self, logits: str, name: str) -> None:
        """Add an output with that name: the class of the highest logit of each pixel."""
        best = self.node("ArgMax", logits, axis=1, keepdims=0)
        self._nodes.append(helper.make_node("Cast", [best], [name], to=TensorProto.UINT8))

    def model(self, shape: tuple[int, ...]) -> ModelProto:
        """Return the complete model, checked by ONNX."""
        describe = helper.make_tensor_value_info
        image = describe("image", TensorProto.UINT8, (*shape, 3))
        class_ids = describe("class_ids", TensorProto.UINT8, shape)
        return self.finish("segmentation", [image], [class_ids], full_check=True)
