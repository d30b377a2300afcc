"""PointPillar as an ONNX graph, from the points of a sweep to boxes before suppression.

Points enter as a list of rows; pillars are numbered in the order of their first points. A pillar
keeps its first points, and its feature is the maximum over them and, if it has room for more, over
an empty slot, which is a row of zeros. One such row is appended for each pillar that is not full.

Example: 3 points in 2 pillars of 2 places give 4 rows with the pillars 0, 0, 1, 1, the last row
being the empty slot of pillar 1.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from onnx import ModelProto, TensorProto, helper

from curate.detectors.openpcdet.anchors import CODE, MOST_LOG
from curate.detectors.openpcdet.network import DetectionNetwork
from curate.detectors.openpcdet.schema import AnchorHead, BaseBEVBackbone, PillarVFE
from curate.errors import ConfigError
from curate.files.onnx_graph import GraphBuilder

_EPSILON = 1e-3  # of OpenPCDet's batch norms in pillars and in the 2D backbone
_FLOAT, _INTEGER, _BOOL = TensorProto.FLOAT, TensorProto.INT64, TensorProto.BOOL


def build_graph(network: DetectionNetwork, raise_by: float = 0.0) -> ModelProto:
    """Return the graph of a network for one sweep.

    The input is `points` (n, 4) float32: x, y, z, intensity in [0, 1] in the LiDAR frame. The
    outputs are `boxes` (k, 7), `scores` (k,) and `labels` (k,) int64, by descending score; k is
    the number of boxes that the model file lets into the suppression.

    Args:
        network: a PointPillar.
        raise_by: metres by which points are raised, and boxes lowered.

    Raises:
        ConfigError: if ONNX has no operators for the network.
    """
    name = network.file.model.name
    if name != "PointPillar":
        raise ConfigError(
            f"{name} cannot be exported: ONNX has no sparse convolution; PointPillar can. The "
            "checkpoint itself runs with detector 'openpcdet', on a CPU or a GPU"
        )
    graph = _Graph({key: each.numpy() for key, each in network.state_dict().items()})
    numbers, features = graph.pillars("points", network, raise_by)
    maps = graph.canvas(numbers, features, network)
    joined = graph.backbone(maps, network.file.model.backbone_2d)
    graph.boxes(joined, numbers, network, raise_by)
    count = min(len(network.anchors), _most(network))
    describe = helper.make_tensor_value_info
    return graph.finish(
        "pointpillar",
        [describe("points", _FLOAT, ["n", 4])],
        [
            describe("boxes", _FLOAT, [count, 7]),
            describe("scores", _FLOAT, [count]),
            describe("labels", _INTEGER, [count]),
        ],
    )


def _most(network: DetectionNetwork) -> int:
    """Return the number of boxes that enter the suppression."""
    return network.file.model.post_processing.nms_config.nms_pre_maxsize


class _Graph(GraphBuilder):
    """Builder of the parts of the network; values are referred to by name."""

    def pillars(self, points: str, network: DetectionNetwork, raise_by: float) -> tuple[str, str]:
        """Return the (m,) cells of the pillars and their (m, channels) features."""
        data, vfe = network.file.data_config, network.file.model.vfe
        assert isinstance(vfe, PillarVFE)  # noqa: S101 - it is a PointPillar
        limits = np.array(data.point_cloud_range, np.float32).reshape(2, 3)
        size = np.array(data.voxels.voxel_size, np.float32)
        places = data.voxels.max_points_per_voxel
        if raise_by:
            points = self.node("Add", points, self.floats([0, 0, raise_by, 0]))
        rows, cells = self.in_range(points, limits, size, data.grid)
        along_x, along_y = self.column(cells, 0), self.column(cells, 1)
        numbers = self.node("Add", self.node("Mul", along_y, self.integers(data.grid[0])), along_x)
        pillar, numbers, counts, kept = self.grouped(
            numbers, places, data.voxels.max_number_of_voxels.test
        )
        rows = self.node("Gather", rows, kept)
        xyz = self.node("Gather", rows, self.integers(0, 1, 2), axis=1)
        sums = self.scattered(pillar, xyz, self.zeros(self.node("Size", numbers), 3), "add")
        means = self.node("Div", sums, self.as_column(self.node("Cast", counts, to=_FLOAT)))
        centres = self.centres(numbers, data.grid[0], size, limits[0] + size / 2)
        features = self.point_features(rows, xyz, pillar, (means, centres), vfe)
        room = self.where(self.node("Less", counts, self.integers(places)))
        layers = [f"vfe.pfn_layers.{number}" for number in range(len(vfe.num_filters))]
        width = self._weights[f"{layers[0]}.linear.weight"].shape[1]
        empty = self.zeros(self.node("Size", room), width)
        features = self.node("Concat", features, empty, axis=0)
        pillar = self.node("Concat", pillar, room, axis=0)
        highest = features
        for layer in layers:
            scale, shift = self.norm(f"{layer}.norm")
            matrix = self.constant((self._weights[f"{layer}.linear.weight"] * scale[:, None]).T)
            values = self.node("Relu", self.node("Gemm", features, matrix, self.constant(shift)))
            nothing = self.zeros(self.node("Size", numbers), len(scale))
            highest = self.scattered(pillar, values, nothing, "max")
            again = self.node("Gather", highest, pillar)
            features = self.node("Concat", values, again, axis=1)
        return numbers, highest

    def in_range(
        self, points: str, limits: np.ndarray, size: np.ndarray, grid: Sequence[int]
    ) -> tuple[str, str]:
        """Return the points in the range, and their (n, 3) cells x, y, z."""
        xyz = self.node("Gather", points, self.integers(0, 1, 2), axis=1)
        places = self.node("Sub", xyz, self.constant(limits[0]))
        cells = self.node("Floor", self.node("Div", places, self.constant(size)))
        # The range cuts x and y only; z is cut by the cells.
        low, high = ([*limits[end, :2], infinity] for end, infinity in enumerate((-np.inf, np.inf)))
        tests = (
            self.node("GreaterOrEqual", xyz, self.floats(low)),
            self.node("LessOrEqual", xyz, self.floats(high)),
            self.node("GreaterOrEqual", cells, self.floats([0])),
            self.node("Less", cells, self.floats(grid)),
        )
        both = (self.node("And", *tests[:2]), self.node("And", *tests[2:]))
        numbers = self.node("Cast", self.node("And", *both), to=TensorProto.INT32)
        every = self.node("ReduceMin", numbers, self.integers(1), keepdims=0)
        inside = self.where(self.node("Cast", every, to=_BOOL))
        cells = self.node("Cast", self.node("Gather", cells, inside), to=_INTEGER)
        return self.node("Gather", points, inside), cells

    def grouped(self, numbers: str, places: int, most: int) -> tuple[str, str, str, str]:
        """Return the kept points by pillar, and the pillars in the order of their first points.

        Returns:
            Of each kept point its pillar; of each of the m pillars its cell and the number of its
            kept points; the rows of the kept points.
        """
        cells, pillars, counts = (f"{numbers}.{part}" for part in ("cells", "pillars", "counts"))
        unique = helper.make_node("Unique", [numbers], [cells, "", pillars, counts], sorted=0)
        self._nodes.append(unique)
        # Sorted by pillar and then by row, the place of a point in its pillar is its distance from
        # the pillar's first point.
        count = self.node("Size", numbers)
        rows = self.node("Range", self.scalar(0), count, self.scalar(1))
        keys = self.node("Add", self.node("Mul", pillars, count), rows)
        order = f"{numbers}.order"
        length = self.node("Reshape", count, self.integers(1))
        sort = helper.make_node("TopK", [keys, length], [f"{order}.keys", order], largest=0)
        self._nodes.append(sort)
        of_sorted = self.node("Gather", pillars, order)
        starts = self.node("CumSum", counts, self.scalar(0), exclusive=1)
        place = self.node("Sub", rows, self.node("Gather", starts, of_sorted))
        fits = self.node("Less", place, self.integers(places))
        early = self.node("Less", of_sorted, self.integers(most))
        kept = self.node("Gather", order, self.where(self.node("And", fits, early)))
        cut = [self.integers(0), self.integers(most)]
        cells, counts = (self.node("Slice", each, *cut) for each in (cells, counts))
        counts = self.node("Min", counts, self.integers(places))
        return self.node("Gather", pillars, kept), cells, counts, kept

    def centres(self, numbers: str, across: int, size: np.ndarray, first: np.ndarray) -> str:
        """Return the (m, 3) centres of the pillars."""
        width = self.integers(across)
        parts = [self.node("Mod", numbers, width), self.node("Div", numbers, width)]
        cells = [self.as_column(self.node("Cast", each, to=_FLOAT)) for each in parts]
        flat = self.node("Mul", cells[0], self.floats([0]))
        places = self.node("Concat", *cells, flat, axis=1)
        scaled = self.node("Mul", places, self.constant(size))
        return self.node("Add", scaled, self.constant(first))

    def point_features(
        self, rows: str, xyz: str, pillar: str, middles: tuple[str, str], vfe: PillarVFE
    ) -> str:
        """Return the (n, columns) features of points."""
        own = rows if vfe.use_abslote_xyz else self.node(
            "Gather", rows, self.integers(3), axis=1
        )  # fmt: skip
        columns = [own]
        columns += [self.node("Sub", xyz, self.node("Gather", each, pillar)) for each in middles]
        if vfe.with_distance:
            columns.append(self.node("ReduceL2", xyz, self.integers(1), keepdims=1))
        return self.node("Concat", *columns, axis=1)

    def canvas(self, numbers: str, features: str, network: DetectionNetwork) -> str:
        """Return the (1, channels, y, x) map with the pillars' features, 0 elsewhere."""
        across_x, across_y, _ = network.file.data_config.grid
        channels = network.file.bev_channels
        shape = self.integers(across_x * across_y, channels)
        flat = self.scattered(numbers, features, self.node("ConstantOfShape", shape), "none")
        maps = self.node("Reshape", flat, self.integers(1, across_y, across_x, channels))
        return self.node("Transpose", maps, perm=[0, 3, 1, 2])

    def backbone(self, maps: str, config: BaseBEVBackbone) -> str:
        """Return the joined maps of the 2D backbone."""
        parts = []
        for level, layers in enumerate(config.layer_nums):
            for layer in range(layers + 1):
                name, first = f"backbone_2d.blocks.{level}", 1 + 3 * layer
                stride = 1 if layer else config.layer_strides[level]
                maps = self.convolution(maps, f"{name}.{first}", f"{name}.{first + 1}", stride)
            name = f"backbone_2d.deblocks.{level}"
            parts.append(self.upsampled(maps, name, config.upsample_strides[level]))
        return self.node("Concat", *parts, axis=1)

    def convolution(self, maps: str, name: str, norm: str, stride: int) -> str:
        """Return the output of a 3 x 3 convolution, batch norm and ReLU."""
        scale, shift = self.norm(norm)
        kernel = self.constant(self._weights[f"{name}.weight"] * scale[:, None, None, None])
        inputs = [maps, kernel, self.constant(shift)]
        convolved = self.node("Conv", *inputs, strides=[stride] * 2, pads=[1] * 4)
        return self.node("Relu", convolved)

    def upsampled(self, maps: str, name: str, stride: int) -> str:
        """Return the output of a transposed convolution, batch norm and ReLU."""
        scale, shift = self.norm(f"{name}.1")
        kernel = self.constant(self._weights[f"{name}.0.weight"] * scale[:, None, None])
        inputs = [maps, kernel, self.constant(shift)]
        return self.node("Relu", self.node("ConvTranspose", *inputs, strides=[stride] * 2))

    def norm(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the factor and summand that equal a batch norm."""
        mean, variance = (self._weights[f"{name}.running_{part}"] for part in ("mean", "var"))
        scale = self._weights[f"{name}.weight"] / np.sqrt(variance + _EPSILON)
        return scale, self._weights[f"{name}.bias"] - mean * scale

    def boxes(self, maps: str, numbers: str, network: DetectionNetwork, raise_by: float) -> None:
        """Add the outputs: the boxes with the highest scores."""
        head = network.file.model.dense_head
        count = min(len(network.anchors), _most(network))
        logits = self.by_anchor(maps, "cls", len(network.file.class_names))
        best = self.node("ReduceMax", logits, self.integers(1), keepdims=0)
        index = f"{best}.order"
        top = [best, self.integers(count)]
        self._nodes.append(helper.make_node("TopK", top, [f"{best}.top", index]))
        labels = self.node("ArgMax", logits, axis=1, keepdims=0)
        self.output("Gather", "labels", labels, index)
        # Without a pillar there is nothing to detect.
        some = self.node("Min", self.node("Size", numbers), self.integers(1))
        scores = self.node("Sigmoid", f"{best}.top")
        self.output("Mul", "scores", scores, self.node("Cast", some, to=_FLOAT))
        anchors = self.node("Gather", self.constant(network.anchors.numpy()), index)
        codes = self.node("Gather", self.by_anchor(maps, "box", CODE), index)
        yaws = self.node("Add", self.columns(codes, 6), self.columns(anchors, 6))
        if head.has_directions:
            directions = self.by_anchor(maps, "dir_cls", head.num_dir_bins)
            bins = self.node("ArgMax", self.node("Gather", directions, index), axis=1)
            yaws = self.turned(yaws, bins, head)
        sizes = self.columns(anchors, 3, 4, 5)
        edges = self.columns(anchors, 3, 4)
        diagonal = self.node("ReduceL2", edges, self.integers(1), keepdims=1)
        scale = self.node("Concat", diagonal, diagonal, self.columns(anchors, 5), axis=1)
        offsets = self.node("Mul", self.columns(codes, 0, 1, 2), scale)
        centres = self.node("Add", offsets, self.columns(anchors, 0, 1, 2))
        if raise_by:
            centres = self.node("Sub", centres, self.floats([0, 0, raise_by]))
        ends = [self.scalar(end, np.float32) for end in (-MOST_LOG, MOST_LOG)]
        growth = self.node("Exp", self.node("Clip", self.columns(codes, 3, 4, 5), *ends))
        self.output("Concat", "boxes", centres, self.node("Mul", growth, sizes), yaws, axis=1)

    def turned(self, yaws: str, bins: str, config: AnchorHead) -> str:
        """Return (k, 1) yaws with the direction of their (k, 1) bin."""
        period = 2 * np.pi / config.num_dir_bins
        offset, start = self.floats([config.dir_offset]), self.floats([config.dir_limit_offset])
        away = self.node("Sub", yaws, offset)
        turns = self.node("Add", self.node("Div", away, self.floats([period])), start)
        turns = self.node("Sub", self.node("Cast", bins, to=_FLOAT), self.node("Floor", turns))
        return self.node("Add", yaws, self.node("Mul", turns, self.floats([period])))

    def by_anchor(self, maps: str, name: str, numbers: int) -> str:
        """Return the (anchors, numbers) outputs of a 1 x 1 convolution of the head."""
        key = f"dense_head.conv_{name}"
        parameters = [self.constant(self._weights[f"{key}.{part}"]) for part in ("weight", "bias")]
        last = self.node("Transpose", self.node("Conv", maps, *parameters), perm=[0, 2, 3, 1])
        return self.node("Reshape", last, self.integers(-1, numbers))

    def output(self, operator: str, name: str, *inputs: str, **attributes: Any) -> None:
        """Add an operator with an output of the graph."""
        self._nodes.append(helper.make_node(operator, inputs, [name], **attributes))

    def scattered(self, rows: str, values: str, start: str, reduction: str) -> str:
        """Return an array with (n, c) values put at (n,) rows."""
        return self.node("ScatterND", start, self.as_column(rows), values, reduction=reduction)

    def where(self, mask: str) -> str:
        """Return the indices at which a (n,) mask is true."""
        return self.node("Squeeze", self.node("NonZero", mask), self.integers(0))

    def zeros(self, rows: str, columns: int) -> str:
        """Return a (rows, columns) array of zeros; `rows` is a scalar."""
        count = self.node("Reshape", rows, self.integers(1))
        return self.node(
            "ConstantOfShape", self.node("Concat", count, self.integers(columns), axis=0)
        )

    def as_column(self, values: str) -> str:
        """Return (n,) values as (n, 1)."""
        return self.node("Unsqueeze", values, self.integers(1))

    def column(self, values: str, index: int) -> str:
        """Return a column of (n, c) values as (n,)."""
        return self.node("Squeeze", self.columns(values, index), self.integers(1))

    def columns(self, values: str, *index: int) -> str:
        """Return some columns of (n, c) values."""
        return self.node("Gather", values, self.integers(*index), axis=1)

    def integers(self, *values: int) -> str:
        """Return a constant (n,) of integers."""
        return self.constant(np.array(values, dtype=np.int64))

    def floats(self, values: Sequence[float]) -> str:
        """Return a constant (n,) of floats."""
        return self.constant(np.array(values, dtype=np.float32))

    def scalar(self, value: float, kind: type = np.int64) -> str:
        """Return a constant without axes."""
        return self.node("Squeeze", self.constant(np.array([value], dtype=kind)))
