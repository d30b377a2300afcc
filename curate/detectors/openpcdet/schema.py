"""The part of OpenPCDet's model files (YAML) that describes PointPillar, SECOND and Voxel R-CNN.

A key or module that is not listed here is rejected by name: it could change what the network
computes. Keys that only concern OpenPCDet's own data preparation, training and evaluation are
accepted and not used.

Source: the model files of OpenPCDet (Shi et al., github.com/open-mmlab/OpenPCDet) for KITTI.

Two keys are curate's own: `BACKBONE_3D.CHANNELS`, the widths of the sparse backbone, which are
fixed in OpenPCDet, and `ROI_HEAD.SCORE`, what the score of Voxel R-CNN is.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from curate.errors import ConfigError, first_line
from curate.spelling import did_you_mean

# Keys of OpenPCDet that change neither the network nor its outputs.
_UNUSED_DATA_KEYS = {
    "DATASET", "DATA_PATH", "DATA_SPLIT", "INFO_PATH", "DATA_AUGMENTOR", "GET_ITEM_LIST",
    "BALANCED_RESAMPLING", "FOV_POINTS_ONLY", "INCLUDE_KITTI_INFOS", "CLASS_NAMES",
}  # fmt: skip
_UNUSED_KEYS = {"OPTIMIZATION", "ROOT_DIR", "LOCAL_RANK", "TAG", "EXP_GROUP_PATH"}
# The base file of the published KITTI models, for model files that lie alone.
_KITTI_BASE: Mapping[str, Any] = {
    "POINT_CLOUD_RANGE": [0, -40, -3, 70.4, 40, 1],
    "POINT_FEATURE_ENCODING": {
        "encoding_type": "absolute_coordinates_encoding",
        "used_feature_list": ["x", "y", "z", "intensity"],
        "src_feature_list": ["x", "y", "z", "intensity"],
    },
    "DATA_PROCESSOR": [
        {"NAME": "mask_points_and_boxes_outside_range", "REMOVE_OUTSIDE_BOXES": True},
        {"NAME": "shuffle_points", "SHUFFLE_ENABLED": {"train": True, "test": False}},
        {
            "NAME": "transform_points_to_voxels",
            "VOXEL_SIZE": [0.05, 0.05, 0.1],
            "MAX_POINTS_PER_VOXEL": 5,
            "MAX_NUMBER_OF_VOXELS": {"train": 16000, "test": 40000},
        },
    ],
}
_MOST_FAULTS = 3
_COLUMNS = ("x", "y", "z", "intensity")
# Cells of the map before the 2D backbone; the public models have 35,000 to 300,000.
_MOST_CELLS = 4096 * 4096

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]


def _check_columns(names: tuple[str, ...]) -> tuple[str, ...]:
    if names != _COLUMNS:
        raise ValueError(f"{', '.join(names)}: curate gives a detector {', '.join(_COLUMNS)}")
    return names


Columns = Annotated[tuple[str, ...], AfterValidator(_check_columns)]


class _Section(BaseModel):
    """A section with keys in capitals; unknown keys are errors."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, alias_generator=str.upper, populate_by_name=True
    )


class _LowerSection(BaseModel):
    """A section with keys in small letters."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class PointFeatures(_LowerSection):
    """The columns of a point: x, y, z and intensity, as they are."""

    encoding_type: Literal["absolute_coordinates_encoding"]
    used_feature_list: Columns
    src_feature_list: Columns


class Caps(_LowerSection):
    """Highest number of voxels of a frame in training and in inference."""

    train: Count
    test: Count


class Voxelisation(_Section):
    """How points become voxels: edges in metres along x, y, z, and caps."""

    name: Literal["transform_points_to_voxels"]
    voxel_size: tuple[Positive, Positive, Positive]
    max_points_per_voxel: Count
    max_number_of_voxels: Caps


class RangeMask(_Section):
    """Points outside the range are dropped."""

    name: Literal["mask_points_and_boxes_outside_range"]
    remove_outside_boxes: bool = True


class Shuffle(_Section):
    """OpenPCDet's shuffling of the points; curate keeps their order, so results repeat."""

    name: Literal["shuffle_points"]
    shuffle_enabled: dict[str, bool] = Field(default_factory=dict)


class Data(_Section):
    """The range, the grid and the columns of the points."""

    point_cloud_range: tuple[Number, Number, Number, Number, Number, Number]
    point_feature_encoding: PointFeatures
    data_processor: tuple[
        Annotated[RangeMask | Shuffle | Voxelisation, Field(discriminator="name")], ...
    ]

    @property
    def voxels(self) -> Voxelisation:
        """The voxelisation among the processing steps."""
        return next(each for each in self.data_processor if isinstance(each, Voxelisation))

    @property
    def grid(self) -> tuple[int, int, int]:
        """Voxels along x, y, z."""
        low, high = self.point_cloud_range[:3], self.point_cloud_range[3:]
        size = self.voxels.voxel_size
        counts = [round((b - a) / s) for a, b, s in zip(low, high, size, strict=True)]
        return counts[0], counts[1], counts[2]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if sum(isinstance(each, Voxelisation) for each in self.data_processor) != 1:
            raise ValueError("DATA_PROCESSOR needs transform_points_to_voxels once")
        if min(self.grid) < 1:
            raise ValueError("POINT_CLOUD_RANGE: give x, y, z low, then x, y, z high")
        return self


class MeanVFE(_Section):
    """A voxel's feature is the mean of its points."""

    name: Literal["MeanVFE"]


class PillarVFE(_Section):
    """A pillar's feature is the maximum of a small network over its points."""

    name: Literal["PillarVFE"]
    with_distance: bool = False
    use_abslote_xyz: bool = True
    use_norm: Literal[True] = True
    num_filters: tuple[Count, ...] = Field(min_length=1)


class VoxelBackBone8x(_Section):
    """The sparse 3D backbone; `channels` are those of its input, four levels and output."""

    name: Literal["VoxelBackBone8x"]
    channels: tuple[Count, Count, Count, Count, Count, Count] = (16, 16, 32, 64, 64, 128)


class MapToBEV(_Section):
    """How voxels or pillars become a map in bird's eye view."""

    name: Literal["HeightCompression", "PointPillarScatter"]
    num_bev_features: Count


class BaseBEVBackbone(_Section):
    """The 2D backbone: levels that halve the resolution, and their upsampled sum of channels."""

    name: Literal["BaseBEVBackbone"]
    layer_nums: tuple[Annotated[int, Field(ge=0)], ...]
    layer_strides: tuple[Count, ...]
    num_filters: tuple[Count, ...]
    upsample_strides: tuple[Count, ...]
    num_upsample_filters: tuple[Count, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        lists = (self.layer_strides, self.num_filters, self.upsample_strides,
                 self.num_upsample_filters)  # fmt: skip
        if any(len(each) != len(self.layer_nums) for each in lists) or not self.layer_nums:
            raise ValueError("BACKBONE_2D: all lists need one number per level")
        return self


class Anchors(_LowerSection):
    """The anchors of a class: sizes in metres, rotations in radians, z of their bottom in metres.

    Anchors that overlap an object by at least `matched_threshold` (nearest axis-aligned BEV IoU)
    learn it; below `unmatched_threshold` they are background.
    """

    class_name: str
    anchor_sizes: tuple[tuple[Positive, Positive, Positive], ...] = Field(min_length=1)
    anchor_rotations: tuple[Number, ...] = Field(min_length=1)
    anchor_bottom_heights: tuple[Number, ...] = Field(min_length=1)
    align_center: bool = False
    feature_map_stride: Count
    matched_threshold: Share
    unmatched_threshold: Share


class AnchorAssignment(_Section):
    """The assignment of objects to anchors."""

    name: Literal["AxisAlignedTargetAssigner"]
    pos_fraction: Annotated[float, Field(lt=0)] = -1.0
    sample_size: int = 512
    norm_by_num_examples: Literal[False] = False
    match_height: Literal[False] = False
    box_coder: Literal["ResidualCoder"]


class AnchorLossWeights(_LowerSection):
    """Factors of the first stage's loss terms, and of the seven numbers of a box code."""

    cls_weight: Number
    loc_weight: Number
    dir_weight: Number
    code_weights: tuple[Number, Number, Number, Number, Number, Number, Number]


class AnchorLoss(_Section):
    """The loss of the first stage."""

    loss_weights: AnchorLossWeights


class AnchorHead(_Section):
    """The first stage: class scores, box codes and directions of anchors."""

    name: Literal["AnchorHeadSingle"]
    class_agnostic: Literal[False]
    use_direction_classifier: bool | None = None
    dir_offset: Number = 0.0
    dir_limit_offset: Number = 0.0
    num_dir_bins: Count = 2
    anchor_generator_config: tuple[Anchors, ...] = Field(min_length=1)
    target_assigner_config: AnchorAssignment
    loss_config: AnchorLoss

    @property
    def has_directions(self) -> bool:
        """Whether there is a direction classifier: OpenPCDet has one if the key exists."""
        return self.use_direction_classifier is not None

    @property
    def anchors_per_cell(self) -> int:
        """Number of anchors at a cell of the map."""
        return sum(
            len(each.anchor_sizes) * len(each.anchor_rotations) * len(each.anchor_bottom_heights)
            for each in self.anchor_generator_config
        )


class NMS(_Section):
    """Suppression of overlapping boxes of all classes together."""

    nms_type: Literal["nms_gpu", "nms_cpu"]
    multi_classes_nms: Literal[False]
    nms_pre_maxsize: Count
    nms_post_maxsize: Count
    nms_thresh: Share
    use_fast_nms: Literal[False] = False
    score_thresh: Annotated[float, Field(le=0)] = 0.0


class ProposalNMS(_Section):
    """Suppression of proposals in training and in inference."""

    train: NMS
    test: NMS


class PoolLayer(_Section):
    """The pooling of one level of the 3D backbone; radii in metres, ranges in cells z, y, x."""

    mlps: tuple[tuple[Count, Count]]
    query_ranges: tuple[tuple[Count, Count, Count]]
    pool_radius: tuple[Positive]
    nsample: tuple[Count]
    pool_method: Literal["max_pool"]


class GridPool(_Section):
    """The pooling of voxels at a grid of points in each proposal."""

    features_source: tuple[Literal["x_conv1", "x_conv2", "x_conv3", "x_conv4"], ...]
    pre_mlp: bool = True
    grid_size: Count
    pool_layers: dict[str, PoolLayer]

    @model_validator(mode="after")
    def _check(self) -> Self:
        missing = [name for name in self.features_source if name not in self.pool_layers]
        if missing or not self.features_source:
            raise ValueError(f"POOL_LAYERS needs the levels of FEATURES_SOURCE, not only {missing}")
        return self


class ProposalSampling(_Section):
    """Which proposals learn, and what: thresholds are 3D IoU with an object."""

    box_coder: Literal["ResidualCoder"]
    roi_per_image: Count
    fg_ratio: Share
    sample_roi_by_each_class: bool = False
    cls_score_type: Literal["roi_iou"]
    cls_fg_thresh: Share
    cls_bg_thresh: Share
    cls_bg_thresh_lo: Share
    hard_bg_ratio: Share
    reg_fg_thresh: Share


class RoILossWeights(_LowerSection):
    """Factors of the second stage's loss terms, and of the seven numbers of a box code."""

    rcnn_cls_weight: Number
    rcnn_reg_weight: Number
    rcnn_corner_weight: Number
    rcnn_iou3d_weight: Number = 1.0
    code_weights: tuple[Number, Number, Number, Number, Number, Number, Number]


class RoILoss(_Section):
    """The loss of the second stage."""

    cls_loss: Literal["BinaryCrossEntropy"]
    reg_loss: Literal["smooth-l1"]
    corner_loss_regularization: bool
    grid_3d_iou_loss: Literal[False] = False
    loss_weights: RoILossWeights


class VoxelRCNNHead(_Section):
    """The second stage of Voxel R-CNN.

    `score` is a key of curate: "roi" is the score of the second stage, "both" the geometric mean of
    the scores of both stages; see `inference`.
    """

    name: Literal["VoxelRCNNHead"]
    class_agnostic: Literal[True]
    shared_fc: tuple[Count, ...] = Field(min_length=1)
    cls_fc: tuple[Count, ...] = Field(min_length=1)
    reg_fc: tuple[Count, ...] = Field(min_length=1)
    dp_ratio: Annotated[float, Field(ge=0, lt=1)] = 0.0
    score: Literal["roi", "both"] = "roi"
    nms_config: ProposalNMS
    roi_grid_pool: GridPool
    target_config: ProposalSampling
    loss_config: RoILoss


class PostProcessing(_Section):
    """OpenPCDet's score threshold and suppression; curate keeps lower scores as well."""

    recall_thresh_list: tuple[float, ...] = ()
    score_thresh: Share
    output_raw_score: Literal[False] = False
    eval_metric: str = ""
    nms_config: NMS


class Model(_Section):
    """The modules of a network."""

    name: Literal["PointPillar", "SECONDNet", "VoxelRCNN"]
    vfe: Annotated[MeanVFE | PillarVFE, Field(discriminator="name")]
    backbone_3d: VoxelBackBone8x | None = None
    map_to_bev: MapToBEV
    backbone_2d: BaseBEVBackbone
    dense_head: AnchorHead
    roi_head: VoxelRCNNHead | None = None
    post_processing: PostProcessing

    @model_validator(mode="after")
    def _check(self) -> Self:
        pillars = self.name == "PointPillar"
        expected = {
            "VFE": (type(self.vfe) is PillarVFE, pillars, "PillarVFE" if pillars else "MeanVFE"),
            "BACKBONE_3D": (self.backbone_3d is None, pillars, "none" if pillars else "one"),
            "ROI_HEAD": (
                self.roi_head is None,
                self.name != "VoxelRCNN",
                "one" if self.name == "VoxelRCNN" else "none",
            ),
            "MAP_TO_BEV": (
                self.map_to_bev.name == "PointPillarScatter",
                pillars,
                "PointPillarScatter" if pillars else "HeightCompression",
            ),
        }
        for key, (given, wanted, name) in expected.items():
            if given != wanted:
                raise ValueError(f"{key}: {self.name} needs {name}")
        return self


class ModelFile(_Section):
    """A whole model file."""

    class_names: tuple[str, ...] = Field(min_length=1)
    data_config: Data
    model: Model

    @model_validator(mode="after")
    def _check(self) -> Self:
        head = self.model.dense_head
        named = tuple(each.class_name for each in head.anchor_generator_config)
        if sorted(named) != sorted(self.class_names):
            raise ValueError(
                f"ANCHOR_GENERATOR_CONFIG has anchors for {', '.join(named)}; CLASS_NAMES are "
                f"{', '.join(self.class_names)}"
            )
        channels, (across_x, across_y, height) = self.bev_channels, self.data_config.grid
        if self.model.map_to_bev.num_bev_features != channels:
            raise ValueError(f"MAP_TO_BEV.NUM_BEV_FEATURES: these modules give {channels}")
        if self.model.backbone_3d is None and height != 1:
            raise ValueError("VOXEL_SIZE: a pillar is as high as POINT_CLOUD_RANGE")
        first = 8 if self.model.backbone_3d else 1
        if across_x * across_y > _MOST_CELLS * first * first:
            raise ValueError(
                f"POINT_CLOUD_RANGE, VOXEL_SIZE: {across_x} x {across_y} voxels are too many; "
                "give metres"
            )
        strides = {each.feature_map_stride for each in head.anchor_generator_config}
        backbone = self.model.backbone_2d
        stride = first * backbone.layer_strides[0] // backbone.upsample_strides[0]
        if strides != {stride}:
            raise ValueError(
                f"feature_map_stride: the map of these modules has a stride of {stride}"
            )
        if across_x % stride or across_y % stride:
            raise ValueError(f"POINT_CLOUD_RANGE: {across_x} x {across_y} voxels do not divide by "
                             f"feature_map_stride {stride}")  # fmt: skip
        return self

    @property
    def bev_channels(self) -> int:
        """Channels of the map that the 2D backbone gets."""
        model = self.model
        if model.backbone_3d is None:
            assert isinstance(model.vfe, PillarVFE)  # noqa: S101 - checked by Model
            return model.vfe.num_filters[-1]
        return model.backbone_3d.channels[-1] * self.bev_heights

    @property
    def bev_heights(self) -> int:
        """Cells along z of the sparse backbone's output."""
        cells = self.data_config.grid[2] + 1
        for padding in (1, 1, 0, 0):
            cells = (cells + 2 * padding - 3) // 2 + 1
        return cells

    def to_text(self) -> str:
        """Return the file as JSON, which is YAML as well."""
        return self.model_dump_json(by_alias=True, exclude_none=True)


def load_model_file(path: Path) -> ModelFile:
    """Return the model file at a path, with its base file.

    Raises:
        ConfigError: if a file is missing or not YAML, or a key, module or value is not one that
            curate can use; the message names it.
    """
    document = _read(path)
    data = document.get("DATA_CONFIG")
    if isinstance(data, dict) and "_BASE_CONFIG_" in data:
        base = _base(path, str(data["_BASE_CONFIG_"]))
        merged = _merged(base, {key: data[key] for key in data if key != "_BASE_CONFIG_"})
        document = {**document, "DATA_CONFIG": merged}
    return parse_model_file(document, str(path))


def parse_model_file(document: Mapping[str, Any], place: str) -> ModelFile:
    """Return a model file from its parsed content.

    Args:
        document: the content.
        place: its name for messages.

    Raises:
        ConfigError: see `load_model_file`.
    """
    used = {key: value for key, value in document.items() if key not in _UNUSED_KEYS}
    data = used.get("DATA_CONFIG")
    if isinstance(data, dict):
        used["DATA_CONFIG"] = {key: data[key] for key in data if key not in _UNUSED_DATA_KEYS}
    try:
        return ModelFile.model_validate(used)
    except ValidationError as error:
        faults = _innermost(error.errors(include_url=False))
        described = "; ".join(_described(each) for each in faults[:_MOST_FAULTS])
        more = f"; and {len(faults) - _MOST_FAULTS} more" if len(faults) > _MOST_FAULTS else ""
        raise ConfigError(f"{place}: {described}{more}") from None


def _innermost(faults: Sequence[Any]) -> list[Any]:
    """Return the faults without those of a list or section that only follow from one inside."""
    places = [fault["loc"] for fault in faults]
    return [
        fault
        for fault in faults
        if not any(
            len(place) > len(fault["loc"]) and place[: len(fault["loc"])] == fault["loc"]
            for place in places
        )
    ]


def _described(fault: Any) -> str:
    """Return one line about a fault that pydantic found."""
    # The name of the chosen module is part of the location; it is not a key of the file.
    place = ".".join(
        str(part) for part in fault["loc"] if part not in {"MeanVFE", "PillarVFE", *_STEPS}
    )
    kind, value = fault["type"], fault.get("input")
    if kind == "extra_forbidden":
        keys = _keys_of(fault["loc"])
        return f"unknown key {place}{did_you_mean(str(fault['loc'][-1]), keys)}"
    if kind == "missing":
        return f"{place} is missing"
    if kind.startswith("union_tag") or kind == "literal_error":
        expected = fault["ctx"].get("expected_tags") or fault["ctx"].get("expected")
        given = fault["ctx"].get("tag", value if isinstance(value, str | int | float) else "this")
        return f"{place}: {given!r} is not supported; supported: {expected}"
    if kind == "value_error":
        return f"{place + ': ' if place else ''}{fault['ctx']['error']}"
    shown = f"{value!r:.40}: " if isinstance(value, str | int | float) else ""
    return f"{place}: {shown}{fault['msg']}"


_STEPS = {"mask_points_and_boxes_outside_range", "shuffle_points", "transform_points_to_voxels"}


def _keys_of(location: tuple[str | int, ...]) -> list[str]:
    """Return the keys of the section in which a key is unknown, for a suggestion."""
    section: Any = ModelFile
    for part in location[:-1]:
        fields = getattr(section, "model_fields", {})
        section = next(
            (field.annotation for name, field in fields.items() if part in {field.alias, name}),
            None,
        )
    fields = getattr(section, "model_fields", {})
    return [field.alias or name for name, field in fields.items()]


def _base(path: Path, name: str) -> Mapping[str, Any]:
    """Return the base file that a model file names, relative to it or to a folder above it."""
    for folder in path.resolve().parents:
        for candidate in (folder / name, folder / Path(name).name):
            if candidate.is_file():
                return _read(candidate)
    if Path(name).name == "kitti_dataset.yaml":
        return _KITTI_BASE
    raise ConfigError(
        f"{path}: its _BASE_CONFIG_ {name} was not found; put {Path(name).name} beside it"
    )


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the base with the changes; sections are merged, everything else is replaced."""
    result = dict(base)
    for key, value in changes.items():
        known = result.get(key)
        both = isinstance(known, dict) and isinstance(value, dict)
        result[key] = _merged(known, value) if both else value  # type: ignore[arg-type]
    return result


def _read(path: Path) -> dict[str, Any]:
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such model file (YAML)") from None
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split()) or first_line(error)
        raise ConfigError(f"{path}: not a readable YAML file: {reason:.200}") from None
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: not a model file of OpenPCDet: it has no sections")
    return content
