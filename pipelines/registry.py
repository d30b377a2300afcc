"""Every extension point with the names that a configuration may use: one line per extension.

A class from outside is named as `package.module:Class`.
"""

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from curate.errors import ConfigError


@dataclass(frozen=True)
class Registry:
    """Names and the classes behind them, imported when they are asked for."""

    kind: str
    classes: Mapping[str, str]

    def load(self, name: str) -> Any:
        """The class behind a name.

        Raises:
            ConfigError: nobody knows the name, or what it names cannot be imported.
        """
        target = self.classes.get(name, name)
        module_name, _, class_name = target.partition(":")
        if not class_name:
            known = ", ".join(sorted(self.classes))
            raise ConfigError(f"unknown {self.kind} '{name}': use one of {known}, or module:Class")
        try:
            return getattr(importlib.import_module(module_name), class_name)
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"{self.kind} '{name}' cannot be imported: {error}") from error

    def build(
        self,
        name: str,
        *given: Any,
        offered: Mapping[str, Callable[[], Any]],
        options: Mapping[str, Any],
    ) -> Any:
        """An instance.

        Args:
            name: a registered name or `package.module:Class`.
            given: positional arguments, passed as they are.
            offered: keyword arguments, of which those are made that the constructor names.
            options: the user's keyword arguments, all of which the constructor must know.

        Raises:
            ConfigError: the constructor does not know an option, or needs one that is missing.
        """
        factory = self.load(name)
        signature = inspect.signature(factory)
        keywords = {key: make() for key, make in offered.items() if key in signature.parameters}
        try:
            signature.bind(*given, **(keywords := keywords | dict(options)))
        except TypeError as error:
            raise ConfigError(f"{self.kind} '{name}': {error}; takes {signature}") from error
        return factory(*given, **keywords)


DATASETS = Registry(
    "dataset",
    {
        "kitti": "curate.datasets.kitti:KittiDataset",
    },
)
DETECTORS = Registry(
    "detector",
    {
        "pillars": "curate.detectors.pillars:PillarDetector",
        "recorded": "curate.detectors.recorded:RecordedDetector",
    },
)
SEGMENTERS = Registry(
    "segmenter",
    {
        "onnx": "curate.segmenters.onnx:OnnxSegmenter",
        "saved": "curate.segmenters.saved:SavedSegmenter",
        "degraded": "curate.segmenters.degraded:DegradedSegmenter",
    },
)
POLICIES = Registry(
    "policy",
    {
        "pspsl": "curate.weighting.self_paced:PSPSL",
        "spsl": "curate.weighting.self_paced:SPSL",
        "uniform": "curate.weighting.uniform:Uniform",
        "uda": "curate.weighting.uniform:Uniform",
        "uda-cl": "curate.weighting.uda_cl:UDACurriculum",
        "sess": "curate.weighting.uniform:Uniform",
        "3dioumatch": "curate.weighting.iou_match:IoUMatch",
        "st3d": "curate.weighting.st3d:ST3D",
        "hssda": "curate.weighting.hssda:HSSDA",
        "threshold": "curate.weighting.threshold:Threshold",
        "baseline": "curate.weighting.baseline:Baseline",
    },
)
EXECUTORS = Registry(
    "executor",
    {
        "serial": "pipelines.executors.serial:SerialExecutor",
        "process": "pipelines.executors.process:ProcessExecutor",
    },
)
# Detectors that `pretrain` and `train-round` can train; the others are brought by the user.
TRAINABLE = frozenset({"pillars"})
