"""Every extension point with the names that a configuration may use: one line per extension.

A class from outside is named as `package.module:Class`; it is found on PYTHONPATH and in the
current folder.
"""

import importlib
import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, get_origin

from curate.errors import ConfigError, CurateError, one_line
from curate.spelling import did_you_mean
from pipelines.user_modules import import_user_module

if TYPE_CHECKING:
    from curate.detectors.base import TrainableDetector


@dataclass(frozen=True)
class Registry:
    """Names and the classes behind them, imported when they are asked for.

    Attributes:
        kind: of extension, for messages.
        protocol: what each of them offers, as `package.module:Class`.
        classes: likewise, by name.
    """

    kind: str
    protocol: str
    classes: Mapping[str, str]

    def check_name(self, name: str, *others: str) -> None:
        """Check a name without importing anything.

        Raises:
            ConfigError: if it is neither registered, nor `module:Class`, nor one of the others.
        """
        names = sorted((*self.classes, *others))
        if name not in names and not name.partition(":")[2]:
            raise ConfigError(
                f"unknown {self.kind} '{name}': use one of {', '.join(names)}, or module:Class"
                f"{did_you_mean(name, names)}"
            )

    def load(self, name: str) -> Any:
        """Return the class behind a name.

        Raises:
            ConfigError: nobody knows the name, or what it names cannot be imported or called.
        """
        self.check_name(name)
        module_name, _, class_name = self.classes.get(name, name).partition(":")
        importer = importlib.import_module if name in self.classes else import_user_module
        try:
            module = importer(module_name)
        except (ImportError, AttributeError, ConfigError) as error:
            hint = _import_hint(error, module_name)
            raise ConfigError(f"{self.kind} '{name}' cannot be imported: {error}{hint}") from error
        except (Exception, SystemExit) as error:  # the module may be the user's, and do anything
            words = one_line(error, 200)
            raise ConfigError(
                f"{self.kind} '{name}' cannot be imported: its module raises "
                f"{type(error).__name__}: {words}"
            ) from error
        if not hasattr(module, class_name):
            public = [each for each, value in vars(module).items() if isinstance(value, type)]
            raise ConfigError(
                f"{self.kind} '{name}' cannot be imported: {module_name} has no '{class_name}'"
                f"{did_you_mean(class_name, public)}"
            )
        found = getattr(module, class_name)
        if not callable(found):
            raise ConfigError(f"{self.kind} '{name}' is not a class but {found!r:.80}")
        missing = [member for member in _members(self.protocol) if not hasattr(found, member)]
        if isinstance(found, type) and missing:
            raise ConfigError(
                f"{self.kind} '{name}' has no {', '.join(missing)}; see "
                f"{self.protocol.replace(':', '.')}"
            )
        return found

    def takes(self, name: str, argument: str) -> bool:
        """Return whether the constructor behind a name has an argument of that name."""
        return argument in inspect.signature(self.load(name)).parameters

    def check(
        self, name: str, *given: Any, offered: Collection[str], options: Mapping[str, Any]
    ) -> Any:
        """Return the class behind a name, once it is known to accept its arguments.

        Args:
            name: see `build`.
            given: see `build`.
            offered: names of the keyword arguments that the caller can make.
            options: see `build`.

        Raises:
            ConfigError: if it cannot be imported, does not know an option, or needs an argument
                that nobody gives.
        """
        factory = self.load(name)
        parameters = inspect.signature(factory).parameters
        anything = any(each.kind is each.VAR_KEYWORD for each in parameters.values())
        unknown = [] if anything else [key for key in options if key not in parameters]
        if unknown:
            known = list(parameters)[len(given) :]
            raise ConfigError(
                f"{self.kind} '{name}' has no option '{unknown[0]}'"
                f"{did_you_mean(unknown[0], known)}; it has {', '.join(known) or 'none'}"
            )
        made = dict.fromkeys(key for key in offered if key in parameters)
        try:
            inspect.signature(factory).bind(*given, **{**made, **options})
        except TypeError as error:
            raise ConfigError(f"{self.kind} '{name}': {error}") from error
        return factory

    def build(
        self,
        name: str,
        *given: Any,
        offered: Mapping[str, Callable[[], Any]],
        options: Mapping[str, Any],
    ) -> Any:
        """Return an instance.

        Args:
            name: a registered name or `package.module:Class`.
            given: positional arguments, passed as they are.
            offered: keyword arguments, of which those are made that the constructor has.
            options: the user's keyword arguments, all of which the constructor must have.

        Raises:
            ConfigError: see `check`, or if the constructor raises; every `CurateError` passes as
                it is.
        """
        factory = self.check(name, *given, offered=offered.keys(), options=options)
        wanted = inspect.signature(factory).parameters.keys() - options.keys()
        keywords = {key: make() for key, make in offered.items() if key in wanted}
        try:
            return factory(*given, **keywords, **options)
        except CurateError:
            raise
        except Exception as error:  # the class may be the user's, and raise anything
            words = " ".join(f"{type(error).__name__}: {error}".split())
            raise ConfigError(f"{self.kind} '{name}' cannot be made: {words}") from error


DATASETS = Registry(
    "dataset",
    "curate.datasets.base:Dataset",
    {
        "kitti": "curate.datasets.kitti.dataset:KittiDataset",
        "kitti-raw": "curate.datasets.kitti.raw:KittiRawDataset",
        "folder": "curate.datasets.folder:FolderDataset",
        "nuscenes": "curate.datasets.nuscenes:NuScenesDataset",
    },
)
DETECTORS = Registry(
    "detector",
    "curate.detectors.base:Detector",
    {
        "pillars": "curate.detectors.pillars:PillarDetector",
        "onnx": "curate.detectors.onnx:OnnxDetector",
        "recorded": "curate.detectors.recorded:RecordedDetector",
    },
)
SEGMENTERS = Registry(
    "segmenter",
    "curate.segmenters.base:Segmenter",
    {
        "onnx": "curate.segmenters.onnx:OnnxSegmenter",
        "onnx-instances": "curate.segmenters.onnx_instances:OnnxInstanceSegmenter",
        "saved": "curate.segmenters.saved:SavedSegmenter",
        "instances": "curate.segmenters.instances:InstanceSegmenter",
        "degraded": "curate.segmenters.degraded:DegradedSegmenter",
    },
)
PRIORS = Registry(
    "prior",
    "curate.priors.base:Declared",
    {
        "points": "curate.priors.points:PointPrior",
        "semantic": "curate.priors.semantic:SemanticPrior",
        "density": "curate.priors.density:DensityPrior",
    },
)
POLICIES = Registry(
    "policy",
    "curate.weighting.base:Policy",
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
EXPORTERS = Registry(
    "exporter",
    "curate.exporters.base:Exporter",
    {
        "sqlite": "curate.exporters.sqlite:SqliteExporter",
        "kitti": "curate.exporters.kitti:KittiExporter",
        "csv": "curate.exporters.comma_separated:CsvExporter",
        "coco": "curate.exporters.coco:CocoExporter",
        "openpcdet": "curate.exporters.openpcdet:OpenPCDetExporter",
        "st3d": "curate.exporters.st3d:ST3DExporter",
        "mmdet3d": "curate.exporters.mmdet3d:MMDet3DExporter",
        "parquet": "curate.exporters.parquet:ParquetExporter",
        "nuscenes": "curate.exporters.nuscenes:NuScenesExporter",
    },
)
EXECUTORS = Registry(
    "executor",
    "pipelines.engine.executors.base:Executor",
    {
        "serial": "pipelines.engine.executors.serial:SerialExecutor",
        "process": "pipelines.engine.executors.process:ProcessExecutor",
        "ray": "pipelines.engine.executors.ray:RayExecutor",
    },
)
EDITORS = Registry(
    "editor",
    "curate.review.editors.base:Editor",
    {
        "kitti": "curate.review.editors.kitti:KittiEditor",
        "labelcloud": "curate.review.editors.labelcloud:LabelCloudEditor",
        "cvat": "curate.review.editors.cvat:CvatEditor",
    },
)
_TRAINABLE = "curate.detectors.base:TrainableDetector"


def trainable(name: str) -> "type[TrainableDetector] | None":
    """Return the class of a detector that curate can train; None for any other detector.

    Raises:
        ConfigError: if nobody knows the name, it cannot be imported, or its class has some members
            of `TrainableDetector` but lacks others.
    """
    found: type[TrainableDetector] = DETECTORS.load(name)
    members = _members(_TRAINABLE)
    missing = [member for member in members if not hasattr(found, member)]
    if missing == members:
        return None
    if missing:
        raise ConfigError(
            f"detector '{name}' cannot be trained: it has no {', '.join(missing)}; see "
            f"{_TRAINABLE.replace(':', '.')}"
        )
    return found


def trainable_names() -> list[str]:
    """Return the names of the registered detectors that curate can train."""
    return [name for name in DETECTORS.classes if trainable(name)]


def _import_hint(error: Exception, module: str) -> str:
    """Return what to do if it is the named module itself that Python does not find, else ""."""
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing is None or not f"{module}.".startswith(f"{missing}."):
        return ""
    return "; install it, or add its folder to PYTHONPATH"


def _members(protocol: str) -> list[str]:
    """Return the class attributes and methods that a protocol itself declares."""
    module_name, _, class_name = protocol.partition(":")
    members = vars(getattr(importlib.import_module(module_name), class_name))
    fixed = [
        name
        for name, kind in members.get("__annotations__", {}).items()
        if get_origin(kind) is ClassVar
    ]
    methods = [name for name, member in members.items() if _is_method(member)]
    return [*fixed, *(name for name in methods if not name.startswith("_"))]


def _is_method(member: object) -> bool:
    return inspect.isfunction(member) or isinstance(member, classmethod)
