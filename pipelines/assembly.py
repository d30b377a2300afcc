"""Creation of objects from the configuration, and checks that it is possible.

No other module creates detectors, segmenters, priors or policies.
"""

import dataclasses
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from glob import escape
from pathlib import Path
from typing import Any, TypeVar

from curate.category_names import inline_table, listed, mapping
from curate.consistency import ConsistencySettings
from curate.datasets.base import Dataset
from curate.datasets.frame_names import FrameNames
from curate.detectors.base import (
    BatchDetector,
    CopiesDetector,
    DescribesScores,
    Detector,
    TrainableDetector,
    choose_preset,
)
from curate.errors import ConfigError, CurateError, DataError, error_prefix
from curate.exporters.base import DataToExport, Selective
from curate.files.onnx_providers import CPU
from curate.files.toml_text import toml_key
from curate.files.user_command import UserCommand, fill, placeholders
from curate.frames import Calibration
from curate.option_values import describe_wrong_values
from curate.priors.base import EvidenceSource, SequenceSource
from curate.priors.points import PointSettings
from curate.priors.semantic import SemanticSettings
from curate.segmenters.base import DeclaresClasses, Segmenter
from curate.segmenters.map_store import MapStore, StoringSegmenter
from curate.segmenters.renamed import RenamedSegmenter, renamed_classes
from curate.spelling import did_you_mean
from curate.weighting.base import Policy
from pipelines import registry
from pipelines.devices import (
    ModelPlace,
    check_detector_place,
    check_segmenter_place,
    detector_place,
)
from pipelines.workspace.config import Config, TrainSection
from pipelines.workspace.workspace import open_dataset, sha256

Kind = TypeVar("Kind")

# Settings of the trainer with a place of their own, so that train.options does not have them.
_SET_ELSEWHERE = {
    **{name: f"train.{name}" for name in TrainSection.model_fields},
    "steps": "train.pretrain_steps and train.round_steps",
    "learning_rate": "train.learning_rate and train.round_learning_rate",
    "seed": "run.seed",
    "device": "detector.device",
}

SHIPPED_SEGMENTER = Path(__file__).parent.parent / "curate/segmenters/models/simulated.onnx"


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a detector predicts, for detectors that read copies or leave files.

    Attributes:
        folder: folder of the workspace.
        round_number: number e of the round.
        copies: split of the frames with augmented copies that it predicts; results in
            `detector.augmented` are read only then. None if it predicts the frames themselves.
    """

    folder: Path
    round_number: int
    copies: str | None = None


def open_detector(config: Config, path: Path | None, place: Place | None = None) -> Detector:
    """Return the configured detector, loaded from a checkpoint, a model or result files.

    Args:
        config: the configuration.
        path: the checkpoint, model or result files.
        place: workspace and round.
    """
    section = config.detector
    offered = dict(_offered_to_detectors(config))
    if place is not None:
        number = place.round_number
        offered |= {"folder": lambda: place.folder, "round_number": lambda: number}
        if split := place.copies:
            offered["augmented"] = lambda: copies_folder(config, number, split)
    detector: Detector = registry.DETECTORS.build(
        section.name, path, offered=offered, options=section.options
    )
    return detector


def copies_folder(config: Config, round_number: int, split: str) -> Path | None:
    """Return the folder of augmented copies in `detector.augmented`; None if unset.

    Raises:
        ConfigError: if it has an unknown placeholder.
    """
    folder = config.detector.augmented
    return None if folder is None else fill_folder(folder, round_number, split)


def fill_folder(folder: Path, round_number: int, split: str) -> Path:
    """Return a folder of augmented copies with {round} and {split} replaced.

    Raises:
        ConfigError: if it has another placeholder.
    """
    values = {"round": str(round_number), "split": split}
    for name in placeholders(str(folder)):
        if name not in values:
            raise ConfigError(
                f"{folder}: unknown placeholder {{{name}}}{did_you_mean(name, values)}; it has "
                "{round} and {split}"
            )
    return Path(fill(str(folder), values))


def check_detector(config: Config, root: Path = Path()) -> None:
    """Check that the detector's class can be used with its options, without loading a model.

    Args:
        config: the configuration.
        root: folder of the workspace, in which a command runs; it need not exist yet.

    Raises:
        ConfigError: if it cannot be imported, does not accept its options, or does not have the
            configured preset.
    """
    if config.detector.augmented and not registry.DETECTORS.takes(
        config.detector.name, "augmented"
    ):
        raise ConfigError(
            f"detector.augmented is for recorded results, but detector '{config.detector.name}' "
            "predicts the copies itself; remove the setting"
        )
    with error_prefix("detector.augmented"):
        copies_folder(config, 1, "unlabeled")
    with error_prefix("detector.name"):
        registry.DETECTORS.check(
            config.detector.name,
            config.detector.path,
            offered=_offered_to_detectors(config),
            options=config.detector.options,
        )
    check_detector_place(config)
    if runs_elsewhere(config):
        open_detector(config, config.detector.path, Place(root, 1))
    trainable_detector(config)


def trainer_command(command: str, root: Path) -> UserCommand:
    """Return the command of the user's trainer, which runs in the folder of the workspace.

    Raises:
        ConfigError: if it cannot be parsed or started.
    """
    parsed = UserCommand.parse("train command", command)
    parsed.check(root)
    return parsed


def score_meaning(config: Config) -> str | None:
    """Return what a score of the configured detector estimates; None if that is unknown."""
    section = config.detector
    if section.score_meaning or not detects_like(config, DescribesScores):
        return section.score_meaning
    trainable = trainable_detector(config)
    preset = trainable.preset if trainable else ""
    with suppress(CurateError):  # a checkpoint that is gone says nothing
        meaning: str = registry.DETECTORS.load(section.name).score_meaning(
            preset, section.path, section.options
        )
        return meaning
    return None


def describe_score(meaning: str | None) -> str:
    """Return the predicate of a sentence about the score."""
    if meaning is None:
        return "has no known meaning; if you know it, set detector.score_meaning"
    return f"estimates {meaning}"


def runs_elsewhere(config: Config) -> bool:
    """Return whether the detector gets copies of files; it needs no path and loads no model."""
    return detects_like(config, CopiesDetector)


def batch_size(config: Config) -> int:
    """Return how many frames the configured detector gets at a time."""
    if not (detects_like(config, BatchDetector) or runs_elsewhere(config)):
        return 1
    if config.detector.batch_size != "auto":
        return config.detector.batch_size
    detector = registry.DETECTORS.load(config.detector.name)
    place = detector_place(config)
    preferred: int = detector.batch_size(place.hardware if place else CPU.name)
    return preferred


def detects_like(config: Config, protocol: type) -> bool:
    """Return whether the class of the configured detector implements a protocol of detectors."""
    detector = registry.DETECTORS.load(config.detector.name)
    return isinstance(detector, type) and issubclass(detector, protocol)


def _offered_to_detectors(config: Config) -> Mapping[str, Callable[[], Any]]:
    def place() -> ModelPlace:
        return detector_place(config) or ModelPlace()

    return {
        "minimum_score": lambda: config.detector.minimum_score,
        "categories": lambda: config.dataset.categories,
        "threads": lambda: 1,
        "frame_ids": lambda: FrameNames.of_dataset(open_dataset(config)),
        "calibration": lambda: _calibrations(config),
        "wants_views": lambda: wants_views(config),
        "device": lambda: place().device or CPU.name,
        "precision": lambda: config.detector.precision,
        "providers": lambda: place().providers,
        "provider_options": lambda: place().options,
        "open_dataset": lambda: partial(open_dataset, config),
        "timeout_s": lambda: config.detector.timeout_s,
        "camera_view": lambda: config.detector.camera_view,
    }


@dataclasses.dataclass(frozen=True)
class Trainable:
    """A detector that curate can train.

    Attributes:
        detector: class of the detector.
        preset: name of the configured preset.
    """

    detector: type[TrainableDetector]
    preset: str


def trainable_detector(config: Config) -> Trainable | None:
    """Return the configured detector if curate can train it, None if it is external.

    Raises:
        ConfigError: if the detector has no preset of the configured name, or its class cannot be
            used.
    """
    with error_prefix("detector.name"):
        detector = registry.trainable(config.detector.name)
    preset = config.train.preset
    if detector is None:
        return None
    try:
        return Trainable(detector, choose_preset(detector, None if preset == "auto" else preset))
    except ConfigError as error:
        raise ConfigError(f"train.preset of detector '{config.detector.name}': {error}") from None


def trained_detector(config: Config) -> Trainable:
    """Return the configured detector, which has to be one that curate can train.

    Raises:
        ConfigError: if it is external, or `trainable_detector` raises it.
    """
    found = trainable_detector(config)
    if found is None:
        raise ConfigError(f"detector '{config.detector.name}' cannot be trained by curate")
    return found


def wants_views(config: Config) -> bool:
    """Return whether the method uses the consistency loss, for which augmented views are needed."""
    return config.run.method != "pspsl" or config.solve.self_paced


def _calibrations(config: Config) -> Callable[[str], Calibration]:
    """Return a function that reads the calibration of a frame."""
    dataset = open_dataset(config)
    return lambda frame_id: dataset.read(frame_id, points=False).calibration


def open_segmenter(config: Config, store: MapStore | None = None) -> Segmenter:
    """Return the segmenter; it reads and writes the stored maps if its maps can be stored.

    Args:
        config: the configuration.
        store: the folder of the maps, if it is open.

    Raises:
        ConfigError: if no segmenter is configured, or a setting is missing or wrong.
        CurateError: if its model or folder is missing or invalid.
    """
    section = config.segmenter
    path = segmenter_path(config)
    if section.name == "none":
        raise ConfigError(
            "segmenter.name is 'none', and the semantic prior needs a segmenter: set "
            "segmenter.name and segmenter.path in curate.toml, or leave 'semantic' out of "
            "run.priors"
        )
    if path is None:
        raise ConfigError(
            f"segmenter '{section.name}' needs a path: set segmenter.path in curate.toml, or leave "
            "'semantic' out of run.priors"
        )
    segmenter: Segmenter = registry.SEGMENTERS.build(
        _segmenter_name(config),
        path,
        offered={
            **_segmenter_arguments(config),
            "frame_ids": lambda: FrameNames.of_dataset(open_dataset(config)),
            "providers": lambda: section.providers,
            "provider_options": lambda: section.provider_options,
        },
        options=section.options,
    )
    if isinstance(segmenter, DeclaresClasses):
        _check_classes(config, segmenter.classes)
    if stores_maps(config):
        segmenter = StoringSegmenter(
            segmenter, store or open_map_store(config), open_dataset(config)
        )
    return RenamedSegmenter(segmenter, section.rename) if section.rename else segmenter


def why_maps_are_not_stored(config: Config) -> str:
    """Return why the maps of the configured segmenter are not stored; "" if they are."""
    section, name = config.segmenter, _segmenter_name(config)
    if name == "none":
        return "segmenter.name is 'none'"
    if section.cache is None or section.cache_limit == 0:
        return "segmenter.cache_limit is 0"
    with error_prefix("segmenter.name"):
        version = registry.SEGMENTERS.declared(name, "map_version")
    if version is None:
        return (
            f"the maps of segmenter '{name}' are not stored: they are files already, or depend on "
            "more than the image (its class declares no map_version)"
        )
    return ""


def stores_maps(config: Config) -> bool:
    """Return whether the maps of the configured segmenter are stored.

    A class that cannot be imported stores none: `status` works without it, and every stage that
    segments reports it.
    """
    try:
        return not why_maps_are_not_stored(config)
    except ConfigError:
        return False


def open_map_store(config: Config) -> MapStore:
    """Return the folder of the stored maps of the configured segmenter."""
    section = config.segmenter
    root = section.cache or Path("maps")
    return MapStore(root, made_by(config), limit_gib=section.cache_limit)


def made_by(config: Config) -> dict[str, Any]:
    """Return everything besides the image that the maps of the configured segmenter depend on.

    Names of categories that are changed by `segmenter.rename`, the place of the model and the
    providers that run it are not part of it; options of providers are, since they can lower the
    precision.
    """
    name, path = _segmenter_name(config), segmenter_path(config)
    arguments = registry.SEGMENTERS.arguments(
        name,
        path,
        offered=_segmenter_arguments(config),
        options=config.segmenter.options,
    )
    if config.segmenter.provider_options:
        arguments = {**arguments, "provider_options": config.segmenter.provider_options}
    return {
        "segmenter": registry.SEGMENTERS.classes.get(name, name),
        "map_version": registry.SEGMENTERS.declared(name, "map_version"),
        "arguments": arguments,
        "model": [sha256(file) for file in _model_files(path)],
    }


def _model_files(path: Path | None) -> list[Path]:
    """Return a model's file or folder, with the files of its weights, such as model.onnx.data."""
    if path is None or not path.is_file():
        return [path] if path and path.exists() else []
    return sorted(each for each in path.parent.glob(f"{escape(path.name)}*") if each.is_file())


def _segmenter_name(config: Config) -> str:
    """Return the registered name, or the class, of the configured segmenter."""
    return "onnx" if config.segmenter.name == "simulated" else config.segmenter.name


def _segmenter_arguments(config: Config) -> Mapping[str, Callable[[], Any]]:
    """Return functions for the arguments besides the options that decide how maps are made."""
    section = config.segmenter
    classes = "simulated" if section.name == "simulated" else section.classes
    return {
        "classes": lambda: _class_map(section.name, classes),
        "seed": lambda: config.run.seed,
    }


def check_segmenter_names(config: Config) -> None:
    """Check that the segmenter has classes for every category, without loading a model.

    The classes of a user's own segmenter may be known only when it is opened.

    Raises:
        ConfigError: if it has none for a category.
    """
    section = config.segmenter
    classes = section.options.get("classes")
    if classes is None and section.name in {"simulated", "degraded"}:
        classes = _class_map(section.name, "simulated")
    elif classes is None and section.classes is not None:
        classes = _class_map(section.name, section.classes)
    if section.name != "none" and isinstance(classes, Mapping):
        _check_classes(config, classes)


def _check_classes(config: Config, classes: Mapping[str, Any]) -> None:
    """Raise ConfigError if a segmenter's table has no classes for a category."""
    section, categories = config.segmenter, config.dataset.categories
    table = renamed_classes(classes, section.rename or {})
    missing = [name for name in categories if not table.get(name)]
    if not missing:
        return
    others = sorted(set(table) - set(categories))
    similar = mapping(others, missing)
    rename = f"segmenter.rename = {inline_table(similar)}, or " if similar else ""
    known = [f"{toml_key(name)} = {list(table[name])}" for name in categories if table.get(name)]
    suggested = ", ".join([*known, *(f"{toml_key(name)} = [...]" for name in missing)])
    raise ConfigError(
        f"segmenter '{section.name}': its table of classes has {listed(sorted(classes))}, but none "
        f"for {listed(missing)} of dataset.categories: set {rename}segmenter.options.classes = "
        f"{{{suggested}}} with their class ids, or leave 'semantic' out of run.priors"
    )


def check_segmenter(config: Config) -> None:
    """Check that the segmenter's class can be used with its options, without loading a model.

    Raises:
        ConfigError: if it cannot be imported or does not accept its options.
    """
    name = _segmenter_name(config)
    if name != "none":
        with error_prefix("segmenter.name"):
            registry.SEGMENTERS.check(
                name,
                segmenter_path(config),
                offered=("classes", "seed", "frame_ids", "providers", "provider_options"),
                options=config.segmenter.options,
            )
        check_segmenter_place(config)


def _class_map(segmenter: str, classes: str | None) -> Mapping[str, tuple[int, ...]]:
    from curate.segmenters.classes import class_map, missing_classes

    if classes is None:
        raise missing_classes(segmenter)
    return class_map(classes)


def segmenter_path(config: Config) -> Path | None:
    """Return the path of the segmenter's model or folder; None if it is not configured.

    For simulated images it is the model that is part of curate.
    """
    return SHIPPED_SEGMENTER if config.segmenter.name == "simulated" else config.segmenter.path


def open_policy(config: Config, name: str) -> Policy:
    """Return a policy with its settings."""
    section = config.solve
    policy: Policy = registry.POLICIES.build(
        name,
        offered={
            "scope": lambda: section.scope,
            "quantile": lambda: section.quantile,
            "self_paced": lambda: section.self_paced,
            "precision": lambda: section.learned.precision,
            "max_wrong": lambda: section.learned.max_wrong,
        },
        options=section.options.get(name, {}),
    )
    return policy


def check_policy(config: Config, name: str) -> None:
    """Check that a policy can be created with its settings.

    Raises:
        ConfigError: if it cannot be imported, or rejects its options.
    """
    with error_prefix("run.method" if name == config.run.method else "--policy"):
        open_policy(config, name)


def check_executor(config: Config) -> None:
    """Check that the executor's class can be used with its options, without starting it.

    Raises:
        ConfigError: if it cannot be imported or does not accept its options.
    """
    section = config.run
    options = section.executor_options.get(section.executor, {})
    with error_prefix("run.executor"):
        registry.EXECUTORS.check(section.executor, offered=("workers",), options=options)


def check_labels_format(config: Config, dataset: Dataset | None = None) -> None:
    """Check that the labels can be exported in the format for the user's trainer.

    Args:
        config: the configuration.
        dataset: the data set, to check whether the format can hold its labels.

    Raises:
        ConfigError: if the exporter cannot be imported or created, or cannot write such labels.
    """
    with error_prefix("train.labels_format"):
        exporter = registry.EXPORTERS.build(config.train.labels_format, offered={}, options={})
        if dataset is None or not isinstance(exporter, Selective):
            return
        for name in dataset.frame_ids()[:1]:
            with suppress(DataError):  # a damaged frame fails later, in its stage
                frame = dataset.read(name, points=False)
                images = dataset.files(name).images
                exporter.check_data(DataToExport(frame, images, config.dataset.categories))


def check_training_options(config: Config) -> None:
    """Check the further settings of curate's trainer.

    Raises:
        ConfigError: if the trainer does not have one of them, or its value is wrong.
    """
    options = config.train.options
    if not options:
        return
    from curate.training.settings import TrainingSettings

    accepted = [field.name for field in dataclasses.fields(TrainingSettings)]
    names = [name for name in accepted if name not in _SET_ELSEWHERE]
    for name in options:
        if name in _SET_ELSEWHERE:
            raise ConfigError(f"train.options.{name}: set {_SET_ELSEWHERE[name]} instead")
        if name not in names:
            raise ConfigError(
                f"train.options of curate.toml: unknown setting '{name}'"
                f"{did_you_mean(name, accepted)}; it accepts {', '.join(names)}"
            )
    if wrong := describe_wrong_values(TrainingSettings, options):
        raise ConfigError(f"train.options.{wrong}")
    TrainingSettings(**options)


def check_extensions(config: Config, root: Path) -> None:
    """Check every class and command of the configuration, without loading a model.

    Args:
        config: the configuration.
        root: folder of the workspace, in which commands run; it need not exist yet.

    Raises:
        ConfigError: if a class cannot be imported or does not accept its options, or a command
            cannot be started.
    """
    check_detector(config, root)
    if config.train.command is not None:
        trainer_command(config.train.command, root)
    check_segmenter(config)
    check_policy(config, config.run.method)
    check_executor(config)
    check_labels_format(config)
    check_training_options(config)


def consistency_settings(config: Config) -> ConsistencySettings:
    """Return the settings of the comparison of predictions and repredictions."""
    return _from_section(ConsistencySettings, config.repredict)


def open_prior(
    config: Config,
    name: str,
    thresholds: Mapping[str, float],
    *,
    references: Mapping[str, float] | None = None,
    measures: bool = True,
    segmenter: Segmenter | None = None,
) -> EvidenceSource:
    """Return a prior with its settings.

    Args:
        config: the configuration.
        name: name of the prior.
        thresholds: points per category, learned from X_l; passed to priors with this argument.
        references: S/A per category, learned from X_l; passed in the same way.
        measures: whether the prior will read frames; its segmenter is opened only then.
        segmenter: the configured segmenter, if it is open.
    """
    prior: EvidenceSource = registry.PRIORS.build(
        name,
        offered={
            "thresholds": lambda: thresholds,
            "references": lambda: references or {},
            "segmenter": lambda: (segmenter or open_segmenter(config)) if measures else None,
            "settings": lambda: semantic_settings(config),
        },
        options=config.run.prior_options.get(name, {}),
    )
    return prior


def open_sequence_source(config: Config, name: str) -> SequenceSource:
    """Return an evidence source that processes whole sequences, with its options."""
    source: SequenceSource = registry.PRIORS.build(
        name, offered={}, options=config.run.prior_options.get(name, {})
    )
    return source


def check_prior(config: Config, name: str) -> None:
    """Check that an evidence source can be created with its options; this opens its segmenter.

    Raises:
        CurateError: if it cannot be imported or created, or its segmenter cannot be opened.
    """
    with error_prefix("run.priors"):
        whole_sequences = hasattr(registry.PRIORS.load(name), "score_sequence")
        reads_pixels = registry.PRIORS.takes(name, "segmenter")
    if reads_pixels:
        check_segmenter_names(config)
    segmenter = _checked_segmenter(config) if reads_pixels else None
    with error_prefix("run.priors"):
        if whole_sequences:
            open_sequence_source(config, name)
        else:
            thresholds = dict.fromkeys(config.dataset.categories, 1.0)
            open_prior(config, name, thresholds, segmenter=segmenter)


def _checked_segmenter(config: Config) -> Segmenter:
    """Return the opened segmenter; an error names the setting that is wrong."""
    check_segmenter(config)
    try:
        return open_segmenter(config)
    except CurateError as error:
        if str(error).startswith("segmenter"):
            raise
        raise type(error)(f"segmenter.path: {error}") from error


def point_settings(config: Config) -> PointSettings:
    """Return the settings for learning the points per category from X_l."""
    return _from_section(PointSettings, config.points)


def semantic_settings(config: Config) -> SemanticSettings:
    """Return the settings of the semantic prior's formula."""
    return _from_section(SemanticSettings, config.semantic)


def _from_section(settings: type[Kind], section: Any) -> Kind:
    """Return a settings object with the section's values in the fields of the same names."""
    names = [field.name for field in dataclasses.fields(settings)]  # type: ignore[arg-type]
    return settings(**{name: getattr(section, name) for name in names})
