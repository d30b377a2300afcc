"""The extension points, and the names of the registered extensions: one line each.

The configuration refers to any other class as `package.module:Class`, which is imported from
PYTHONPATH or the current folder.
"""

import importlib
import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, get_origin

from curate.errors import ConfigError, CurateError, one_line
from curate.option_values import describe_wrong_values
from curate.spelling import did_you_mean
from pipelines.user_modules import import_user_module

if TYPE_CHECKING:
    from curate.detectors.base import TrainableDetector


@dataclass(frozen=True)
class Registry:
    """The registered classes of one extension point. A class is imported when it is first used.

    Attributes:
        kind: kind of extension, for messages.
        protocol: the protocol that all classes implement, as `package.module:Class`.
        classes: the classes by name, as `package.module:Class`.
    """

    kind: str
    protocol: str
    classes: Mapping[str, str]

    def check_name(self, name: str, *others: str) -> None:
        """Check a name without importing anything.

        Raises:
            ConfigError: if it is not registered, not a `module:Class`, and not one of `others`.
        """
        names = sorted((*self.classes, *others))
        if name not in names and not name.partition(":")[2]:
            raise ConfigError(
                f"unknown {self.kind} '{name}': use one of {', '.join(names)}, or module:Class"
                f"{did_you_mean(name, names)}"
            )

    def load(self, name: str) -> Any:
        """Return the class with a name.

        Raises:
            ConfigError: if the name is unknown, or the class cannot be imported, is not callable or
                lacks a member of the protocol.
        """
        self.check_name(name)
        module_name, _, class_name = self.classes.get(name, name).partition(":")
        importer = importlib.import_module if name in self.classes else import_user_module
        try:
            module = importer(module_name)
        except (ImportError, AttributeError, ConfigError) as error:
            hint = _import_hint(error, module_name)
            raise ConfigError(f"{self.kind} '{name}' cannot be imported: {error}{hint}") from error
        except (Exception, SystemExit) as error:  # a user's module may raise anything
            raise ConfigError(
                f"{self.kind} '{name}' cannot be imported: its module raises "
                f"{type(error).__name__}: {one_line(error, 200)}"
            ) from error
        if not hasattr(module, class_name):
            public = [each for each, value in vars(module).items() if isinstance(value, type)]
            raise ConfigError(
                f"{self.kind} '{name}' cannot be imported: {module_name} has no '{class_name}'"
                f"{did_you_mean(class_name, public)}"
            )
        loaded = getattr(module, class_name)
        if not callable(loaded):
            raise ConfigError(f"{self.kind} '{name}' is not a class but {loaded!r:.80}")
        missing = [member for member in _members(self.protocol) if not hasattr(loaded, member)]
        if isinstance(loaded, type) and missing:
            raise ConfigError(
                f"{self.kind} '{name}' has no {', '.join(missing)}; see "
                f"{self.protocol.replace(':', '.')}"
            )
        return loaded

    def declared(self, name: str, member: str) -> Any:
        """Return a class attribute of a class, or else the default in the protocol."""
        module_name, _, protocol = self.protocol.partition(":")
        default = getattr(getattr(importlib.import_module(module_name), protocol), member)
        return getattr(self.load(name), member, default)

    def arguments(
        self,
        name: str,
        *given: Any,
        offered: Mapping[str, Callable[[], Any]],
        options: Mapping[str, Any],
    ) -> dict[str, Any]:
        """Return the keyword arguments with which `build` calls a class, with its defaults."""
        factory = self.check(name, *given, offered=offered.keys(), options=options)
        bound = inspect.signature(factory).bind(*given, **_keywords(factory, offered, options))
        bound.apply_defaults()
        return dict(list(bound.arguments.items())[len(given) :])

    def takes(self, name: str, argument: str) -> bool:
        """Return whether the constructor of a class has the argument."""
        return argument in inspect.signature(self.load(name)).parameters

    def check(
        self, name: str, *given: Any, offered: Collection[str], options: Mapping[str, Any]
    ) -> Any:
        """Return the class with a name, after a check that it accepts its arguments.

        Args:
            name: see `build`.
            given: see `build`.
            offered: names of the keyword arguments that the caller can supply.
            options: see `build`.

        Raises:
            ConfigError: if the class cannot be imported, does not have an option, gets a value of
                another type or range, or requires an argument that is not supplied.
        """
        factory = self.load(name)
        parameters = inspect.signature(factory).parameters
        variadic = any(each.kind is each.VAR_KEYWORD for each in parameters.values())
        unknown = [] if variadic else [key for key in options if key not in parameters]
        if unknown:
            names = list(parameters)[len(given) :]
            raise ConfigError(
                f"{self.kind} '{name}' has no option '{unknown[0]}'"
                f"{did_you_mean(unknown[0], names)}; it has {', '.join(names) or 'none'}"
            )
        supplied = dict.fromkeys(key for key in offered if key in parameters)
        try:
            inspect.signature(factory).bind(*given, **{**supplied, **options})
        except TypeError as error:
            raise ConfigError(f"{self.kind} '{name}': {error}") from error
        if wrong := describe_wrong_values(factory, options):
            raise ConfigError(f"{self.kind} '{name}': option {wrong}")
        return factory

    def build(
        self,
        name: str,
        *given: Any,
        offered: Mapping[str, Callable[[], Any]],
        options: Mapping[str, Any],
    ) -> Any:
        """Return an instance of the class with a name.

        Args:
            name: a registered name or `package.module:Class`.
            given: positional arguments.
            offered: functions that return keyword arguments. Only those that the constructor has
                are called and passed.
            options: the user's keyword arguments. The constructor must have all of them.

        Raises:
            ConfigError: if `check` raises it, or the constructor raises an exception other than a
                `CurateError`, which is passed on unchanged.
        """
        factory = self.check(name, *given, offered=offered.keys(), options=options)
        keywords = _keywords(factory, offered, options)
        try:
            return factory(*given, **keywords)
        except CurateError:
            raise
        except Exception as error:  # a user's class may raise anything
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise ConfigError(f"{self.kind} '{name}' cannot be created: {reason}") from error


DATASETS = Registry(
    "dataset",
    "curate.datasets.base:Dataset",
    {
        "kitti": "curate.datasets.kitti.dataset:KittiDataset",
        "kitti-raw": "curate.datasets.kitti.raw:KittiRawDataset",
        "kitti-tracking": "curate.datasets.kitti.tracking:KittiTrackingDataset",
        "folder": "curate.datasets.folder:FolderDataset",
        "nuscenes": "curate.datasets.nuscenes:NuScenesDataset",
    },
)
DETECTORS = Registry(
    "detector",
    "curate.detectors.base:Detector",
    {
        "pillars": "curate.detectors.pillars:PillarDetector",
        "openpcdet": "curate.detectors.openpcdet:OpenPCDetDetector",
        "onnx": "curate.detectors.onnx:OnnxDetector",
        "recorded": "curate.detectors.recorded:RecordedDetector",
        "command": "curate.detectors.command:CommandDetector",
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
    "curate.priors.base:EvidenceDeclaration",
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
        "learned": "curate.weighting.learned:Learned",
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
        "auto": "pipelines.engine.executors.auto:AutoExecutor",
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
        ConfigError: if the name is unknown, the class cannot be imported, or it has only some of
            the members of `TrainableDetector`.
    """
    detector: type[TrainableDetector] = DETECTORS.load(name)
    members = _members(_TRAINABLE)
    missing = [member for member in members if not hasattr(detector, member)]
    if missing == members:
        return None
    if missing:
        raise ConfigError(
            f"detector '{name}' cannot be trained: it has no {', '.join(missing)}; see "
            f"{_TRAINABLE.replace(':', '.')}"
        )
    return detector


def trainable_names() -> list[str]:
    """Return the names of the registered detectors that curate can train."""
    return [name for name in DETECTORS.classes if trainable(name)]


def detector_and_preset(name: str) -> tuple[str, str | None]:
    """Return a detector's name and its preset; the name of a preset selects its detector.

    Raises:
        ConfigError: if there is neither a detector nor a preset with the name.
    """
    if name in DETECTORS.classes or ":" in name:
        return name, None
    owners = {
        preset: owner
        for owner in reversed(trainable_names())  # of equal names, the first one counts
        for preset in DETECTORS.load(owner).presets
    }
    DETECTORS.check_name(name, *owners)
    return owners[name], name


def _keywords(
    factory: Callable[..., Any],
    offered: Mapping[str, Callable[[], Any]],
    options: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the keyword arguments of a constructor: those offered that it has, and the options."""
    accepted = inspect.signature(factory).parameters.keys() - options.keys()
    return {**{key: make() for key, make in offered.items() if key in accepted}, **options}


def _import_hint(error: Exception, module: str) -> str:
    """Return what to do if it is the named module itself that Python does not find, else ""."""
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if missing is None or not f"{module}.".startswith(f"{missing}."):
        return ""
    return "; install it, or add its folder to PYTHONPATH"


def _members(protocol: str) -> list[str]:
    """Return the class attributes and public methods that a protocol declares itself."""
    module_name, _, class_name = protocol.partition(":")
    members = vars(getattr(importlib.import_module(module_name), class_name))
    attributes = [
        name
        for name, kind in members.get("__annotations__", {}).items()
        if get_origin(kind) is ClassVar
    ]
    methods = [name for name, member in members.items() if _is_method(member)]
    return [*attributes, *(name for name in methods if not name.startswith("_"))]


def _is_method(member: object) -> bool:
    return inspect.isfunction(member) or isinstance(member, classmethod)
