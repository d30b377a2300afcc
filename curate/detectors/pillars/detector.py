"""The trained pillar detector: runs in ONNX Runtime on the CPU and in torch on a GPU."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from curate.detections import Detections
from curate.detectors.devices import check_device
from curate.detectors.pillars.checkpoint import (
    FORMAT_VERSION,
    GRAPH_DIGEST,
    Checkpoint,
    digest_of,
    graph_of,
    graph_path,
    load_checkpoint,
    write_graph,
)
from curate.detectors.pillars.encoding import Pillars, decode, encode_points, joined
from curate.detectors.pillars.presets import PRESETS
from curate.detectors.precision import FLOAT32, Precision, mixed_precision
from curate.errors import ModelError
from curate.files.onnx_providers import (
    AUTO,
    CPU,
    ProviderOptions,
    Providers,
    listed_providers,
    open_session,
    runtime_errors,
)
from curate.files.paths import StrPath
from curate.frames import Frame
from curate.geometry.ground import GroundMap
from curate.geometry.nms import nms_bev
from curate.ranges import AtLeastOne, Share

if TYPE_CHECKING:
    from curate.detectors.pillars.training import PillarStudent

FrameOutput = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Scores, box codes and estimated IoU of one frame."""
Forward = Callable[[Sequence[Pillars]], list[FrameOutput]]
"""Runs the network on several frames."""

# Frames that a GPU gets at a time.
_GPU_BATCH = 8


class PillarDetector:
    """A `Detector` that runs a checkpoint trained by `curate.training`.

    Args:
        checkpoint: the safetensors file.
        device: "cpu" for ONNX Runtime, or a device of torch such as "cuda".
        minimum_score: boxes with a lower score are left out.
        nms_iou: BEV IoU above which the higher-scored box of a category suppresses the other.
        threads: number of threads of the network, on the CPU.
        precision: "float32", or in torch "bfloat16" or "float16" (mixed precision).
        providers: providers of ONNX Runtime to use in place of the device; "auto" for none.
        provider_options: options of the providers by their names.

    Raises:
        ModelError: if the checkpoint is missing, damaged, or of another detector or version.
        ConfigError: if the device or a provider cannot be used.
    """

    presets: ClassVar[Collection[str]] = PRESETS.keys()
    checkpoint_suffix: ClassVar[str] = ".safetensors"
    checkpoint_version: ClassVar[str] = FORMAT_VERSION

    def __init__(
        self,
        checkpoint: StrPath,
        *,
        device: str = "cpu",
        minimum_score: Share = 0.1,
        nms_iou: Share = 0.1,
        threads: AtLeastOne = 1,
        precision: Precision = FLOAT32,
        providers: Providers = AUTO,
        provider_options: ProviderOptions | None = None,
    ) -> None:
        checkpoint = Path(checkpoint)
        self._checkpoint = load_checkpoint(checkpoint)
        self._minimum_score = minimum_score
        self._nms_iou = nms_iou
        self._forward = (
            onnx_forward(checkpoint, self._checkpoint, threads, providers, provider_options)
            if listed_providers(providers) or (device == CPU.name and precision == FLOAT32)
            else torch_forward(checkpoint, self._checkpoint, device, precision)
        )

    @classmethod
    def check_checkpoint(cls, checkpoint: Path) -> None:
        """See `curate.detectors.base.TrainableDetector`."""
        load_checkpoint(checkpoint)

    @classmethod
    def new_student(cls, preset: str, categories: tuple[str, ...]) -> "PillarStudent":
        """See `curate.detectors.base.TrainableDetector`."""
        from curate.detectors.pillars.training import PillarStudent

        return PillarStudent.new(preset, categories)

    @classmethod
    def load_student(cls, checkpoint: Path) -> "PillarStudent":
        """See `curate.detectors.base.TrainableDetector`."""
        from curate.detectors.pillars.training import PillarStudent

        return PillarStudent.load(checkpoint)

    @property
    def categories(self) -> tuple[str, ...]:
        """The categories that the detector finds."""
        return self._checkpoint.categories

    def category_names(self) -> tuple[str, ...]:
        """See `curate.detectors.base.NamesCategories`."""
        return self.categories

    @classmethod
    def score_meaning(cls, *_: object) -> str:
        """See `curate.detectors.base.DescribesScores`."""
        return "the probability that an object of the category has its centre there (heat map)"

    @classmethod
    def export_onnx(cls, checkpoint: Path, output: Path, _: Mapping[str, Any]) -> tuple[str, ...]:
        """See `curate.detectors.base.ExportsOnnx`."""
        from curate.files.onnx_graph import write_model

        loaded = load_checkpoint(checkpoint)
        write_model(graph_of(checkpoint, loaded), output)
        return (
            "in: features and slots, from encode_points in curate.detectors.pillars.encoding",
            "out: maps of scores, codes and ious, which decode in that module turns into boxes",
            f"of preset {loaded.preset.name} with categories {', '.join(loaded.categories)}",
        )

    @classmethod
    def batch_size(cls, device: str) -> int:
        """See `curate.detectors.base.BatchDetector`."""
        return 1 if device == CPU.name else _GPU_BATCH

    def predict(self, frame: Frame) -> Detections:
        """See `curate.detectors.base.Detector`."""
        return self.predict_batch([frame])[0]

    def predict_batch(self, frames: Sequence[Frame]) -> list[Detections]:
        """See `curate.detectors.base.BatchDetector`."""
        grounds = [GroundMap.of(frame.points) for frame in frames]
        pillars = [
            encode_points(ground.lowered(frame.points), self._checkpoint.preset)
            for ground, frame in zip(grounds, frames, strict=True)
        ]
        outputs = iter(self._forward([each for each in pillars if len(each.slots)]))
        return [
            self._detections(next(outputs), ground) if len(each.slots) else Detections.empty()
            for each, ground in zip(pillars, grounds, strict=True)
        ]

    def _detections(self, output: FrameOutput, ground: GroundMap) -> Detections:
        """Return the boxes of one frame after non-maximum suppression, by descending score."""
        found = decode(*output, self.categories, self._checkpoint.preset, self._minimum_score)
        kept = [np.zeros(0, dtype=np.int64)]
        for category in self.categories:
            of_category = np.flatnonzero(found.categories == category)
            best = nms_bev(found.boxes[of_category], found.scores[of_category], self._nms_iou)
            kept.append(of_category[best])
        index = np.concatenate(kept)
        best_first = found.select(index[np.argsort(-found.scores[index], kind="stable")])
        return replace(best_first, boxes=ground.raised(best_first.boxes))


def onnx_forward(
    path: Path,
    checkpoint: Checkpoint,
    threads: int,
    providers: Providers = AUTO,
    options: ProviderOptions | None = None,
) -> Forward:
    """Return a function that runs the checkpoint's ONNX graph in ONNX Runtime, frame by frame.

    Builds the graph first if it is missing or belongs to another checkpoint. Without a list of
    providers it runs on the CPU.
    """
    listed = [each.name for each in listed_providers(providers)] or CPU.name

    def open_graph() -> Any:
        return open_session(graph_path(path), threads, listed, options)

    digest = digest_of(path)
    try:
        session = open_graph()
        outdated = session.get_modelmeta().custom_metadata_map.get(GRAPH_DIGEST) != digest
    except runtime_errors():
        outdated = True
    if outdated:
        write_graph(path, checkpoint, digest)
        session = open_graph()

    def forward_one(pillars: Pillars) -> FrameOutput:
        inputs = {"features": pillars.features, "slots": pillars.slots[:, None]}
        scores, codes, ious = session.run(["scores", "codes", "ious"], inputs)
        return scores, codes, ious[..., 0]

    return lambda frames: [forward_one(pillars) for pillars in frames]


def torch_forward(
    path: Path, checkpoint: Checkpoint, device: str, precision: Precision = FLOAT32
) -> Forward:
    """Return a function that runs the network in torch on a device, all frames in one pass.

    Raises:
        ConfigError: if the device or the precision cannot be used.
        ModelError: if the checkpoint does not fit its preset.
    """
    import torch

    from curate.detectors.pillars.network import network_of

    check_device(device)
    mixed = mixed_precision(precision, device)
    try:
        network = network_of(checkpoint).eval().to(device)
    except ModelError as error:
        raise ModelError(f"{path}: {error}") from None

    def forward(frames: Sequence[Pillars]) -> list[FrameOutput]:
        if not frames:
            return []
        features, slots = joined(frames, checkpoint.preset)
        # NVIDIA's TensorFloat-32 would change the third digit of a score.
        exact = torch.backends.cudnn.flags(enabled=True, allow_tf32=False)
        with torch.inference_mode(), mixed, exact:
            output = network(
                torch.from_numpy(features).to(device, non_blocking=True),
                torch.from_numpy(slots).to(device, non_blocking=True),
                len(frames),
            )
            scores = torch.sigmoid(output.logits.float()).cpu().numpy()
            codes = output.codes.float().cpu().numpy()
            ious = torch.sigmoid(output.iou_logits.float()).cpu().numpy()
        return list(zip(scores, codes, ious, strict=True))

    return forward
