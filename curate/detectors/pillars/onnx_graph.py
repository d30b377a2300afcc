"""The trained network as an ONNX graph, built node by node from the tensors of the checkpoint.

torch's general exporter takes eight seconds for this small network, and needs torch. This builder
needs neither, and folds each batch norm into the product or convolution before it.
"""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto, TensorProto, helper

from curate.detectors.pillars.encoding import BOX_CODE, POINT_FEATURES
from curate.detectors.pillars.presets import Preset
from curate.files.onnx_graph import EPSILON, GraphBuilder


def build_graph(weights: Mapping[str, np.ndarray], preset: Preset, categories: int) -> ModelProto:
    """Return the graph of `network.PillarNetwork` for one frame, with probabilities as scores.

    The inputs of the graph are `features` (n, POINT_FEATURES) float32 and `slots` (n, 1) int64,
    n > 0. The outputs are `scores` (x cells, y cells, categories), `codes` (x cells, y cells,
    BOX_CODE) and `ious` (x cells, y cells, 1).

    Args:
        weights: state of the `PillarNetwork`.
        preset: the preset of the network.
        categories: number of categories.
    """
    graph = _Graph(weights)
    cells_x, cells_y = preset.cells
    pillars = preset.pillar_channels
    values = graph.product("features", "points.0", "points.1")
    empty = graph.constant(np.zeros((4 * cells_x * cells_y, pillars), np.float32))
    canvas = graph.node("ScatterND", empty, "slots", values, reduction="max")
    rows = graph.node("Reshape", canvas, graph.constant(np.array([-1, 4 * pillars])))
    rows = graph.product(rows, "stem.mix", "stem_norm")
    rows = graph.node("Reshape", rows, graph.constant(np.array([1, cells_x, cells_y, -1])))
    maps = graph.node("Transpose", rows, perm=[0, 3, 1, 2])
    fine = graph.scale(maps, "scale1", preset.depths[0], down=False)
    middle = graph.scale(fine, "scale2", 1 + preset.depths[1], down=True)
    coarse = graph.scale(middle, "scale3", 1 + preset.depths[2], down=True)
    middle = graph.node("Add", middle, graph.doubled(graph.pointwise(coarse, "up3")))
    fine = graph.node(
        "Add", graph.pointwise(fine, "side1"), graph.doubled(graph.pointwise(middle, "up2"))
    )
    outputs = graph.output_maps(graph.convolution(fine, "head.0", "head.1"), "answer")
    channels = {"scores": categories, "codes": BOX_CODE, "ious": 1}
    logits, codes, ious = graph.split(outputs, list(channels.values()))
    graph.output(graph.node("Sigmoid", logits), "scores")
    graph.output(codes, "codes")
    graph.output(graph.node("Sigmoid", ious), "ious")
    return graph.model({name: (cells_x, cells_y, count) for name, count in channels.items()})


class _Graph(GraphBuilder):
    """Builder of the parts of the network; values are referred to by name."""

    def split(self, value: str, sizes: list[int]) -> list[str]:
        """Split the channels of a map into parts of these sizes."""
        names = [f"{value}.{part}" for part in range(len(sizes))]
        inputs = [value, self.constant(np.array(sizes))]
        self._nodes.append(helper.make_node("Split", inputs, names, axis=1))
        return names

    def product(self, rows: str, mix: str, norm: str) -> str:
        """Add a matrix product of rows, batch norm and ReLU; return the output's name."""
        scale, shift = self._norm(norm)
        matrix = self.constant((self._weights[f"{mix}.weight"] * scale[:, None]).T)
        return self.node("Relu", self.node("Gemm", rows, matrix, self.constant(shift)))

    def convolution(self, maps: str, name: str, norm: str, stride: int = 1) -> str:
        """Add a 3 x 3 convolution, batch norm and ReLU; return the output's name."""
        scale, shift = self._norm(norm)
        kernel = self.constant(self._weights[f"{name}.weight"] * scale[:, None, None, None])
        inputs = [maps, kernel, self.constant(shift)]
        convolved = self.node("Conv", *inputs, pads=[1, 1, 1, 1], strides=[stride, stride])
        return self.node("Relu", convolved)

    def pointwise(self, maps: str, name: str) -> str:
        """Add a 1 x 1 convolution; return the output's name."""
        kernel = self._weights[f"{name}.mix.weight"]
        return self.node("Conv", maps, self.constant(kernel[:, :, None, None]))

    def output_maps(self, maps: str, name: str) -> str:
        """Add a 1 x 1 convolution with bias and without activation; return the output's name."""
        kernel = self.constant(self._weights[f"{name}.weight"][:, :, None, None])
        return self.node("Conv", maps, kernel, self.constant(self._weights[f"{name}.bias"]))

    def scale(self, maps: str, name: str, convolutions: int, *, down: bool) -> str:
        """Add all convolutions of one scale; `down` gives the first one a stride of 2."""
        for i in range(convolutions):
            stride = 2 if down and i == 0 else 1
            maps = self.convolution(maps, f"{name}.{i}.0", f"{name}.{i}.1", stride)
        return maps

    def doubled(self, maps: str) -> str:
        """Add an upsampling by 2 that repeats each cell; return the output's name."""
        scales = self.constant(np.array([1, 1, 2, 2], np.float32))
        modes = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric"}
        return self.node("Resize", maps, "", scales, nearest_mode="floor", **modes)

    def output(self, maps: str, name: str) -> None:
        """Add (1, c, x, y) maps, transposed to (x, y, c), to the outputs of the graph."""
        single = self.node("Squeeze", maps, self.constant(np.array([0])))
        self._nodes.append(helper.make_node("Transpose", [single], [name], perm=[1, 2, 0]))

    def model(self, outputs: Mapping[str, tuple[int, ...]]) -> ModelProto:
        """Return the complete, checked model."""
        describe = helper.make_tensor_value_info
        inputs = [
            describe("features", TensorProto.FLOAT, ["n", POINT_FEATURES]),
            describe("slots", TensorProto.INT64, ["n", 1]),
        ]
        results = [describe(name, TensorProto.FLOAT, shape) for name, shape in outputs.items()]
        return self.finish("pillars", inputs, results)

    def _norm(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the scale and shift that equal a batch norm in evaluation mode."""
        mean, variance = (self._weights[f"{name}.running_{part}"] for part in ("mean", "var"))
        scale = self._weights[f"{name}.weight"] / np.sqrt(variance + EPSILON)
        return scale, self._weights[f"{name}.bias"] - mean * scale
