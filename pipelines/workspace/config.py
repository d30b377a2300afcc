"""The configuration of a workspace, `curate.toml`: sections, defaults, and what they may hold."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)

from curate.detections import CATEGORIES
from curate.errors import ConfigError, one_line
from curate.files.atomic import replace_file
from curate.files.toml_text import parse_toml

Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
Scale = Annotated[float, Field(gt=0, le=100)]
AtLeastOne = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Options = dict[str, Any]

DEFAULT_PRIORS = ("points", "semantic")


def _each_once(names: tuple[str, ...]) -> tuple[str, ...]:
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ValueError(f"{repeated[0]} is named twice")
    return names


def _rising(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError("the lower limit comes first")
    return limits


class Section(BaseModel):
    """A section refuses keys that it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class DatasetSection(Section):
    """Where the frames are."""

    kind: str = "kitti"
    root: Path
    categories: Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(_each_once)] = (
        CATEGORIES
    )
    split_by: Literal["sequence", "frame"] = "sequence"  # frame: neighbours on both sides
    follow_links: bool = False  # true: links may lead out of root
    options: Options = {}


class DetectorSection(Section):
    """Who guesses."""

    name: str = "pillars"
    path: Path | None = None  # of a detector that the user brings
    device: Literal["auto", "cpu", "cuda"] = "auto"
    minimum_score: Share = 0.1
    camera_view: bool = True  # the detector sees only the points that the camera sees
    options: Options = {}


class SegmenterSection(Section):
    """Who names pixels."""

    name: str = "none"
    path: Path | None = None
    classes: str | None = None  # whose numbers: voc, coco, cityscapes, ... (docs/segmenters.md)
    options: Options = {}


class RepredictSection(Section):
    """The augmented copies A(x), and the consistency loss between the answers."""

    views: AtLeastOne = 1
    flip_probability: Share = 0.5
    rotation_limit_rad: Annotated[float, Field(ge=0)] = 0.7853981633974483
    scale_range: Annotated[tuple[Scale, Scale], AfterValidator(_rising)] = (0.95, 1.05)
    score_weight: Annotated[float, Field(ge=0)] = 1.0
    box_weight: Annotated[float, Field(ge=0)] = 2.0
    beta: Positive = 1 / 9
    minimum_iou: Annotated[float, Field(ge=0, lt=1)] = 0.1


class PointsSection(Section):
    """Eq. 8."""

    statistic: Literal["median", "mean", "quantile", "fixed"] = "median"
    quantile: Share = 0.5
    fixed: Annotated[float, Field(ge=1)] = 5.0
    fallback: Annotated[float, Field(ge=1)] = 5.0


class SemanticSection(Section):
    """Eq. 9."""

    mean: Literal["geometric", "product", "arithmetic"] = "geometric"
    outside: Literal["neutral", "drop"] = "neutral"


class SolveSection(Section):
    """The settings of policies; which of them weighs is `run.method`."""

    scope: Literal["round", "category", "frame"] = "round"  # which labels share one lambda
    quantile: Annotated[float, Field(gt=0, le=1)] | None = None  # in place of Eq. 4's maximum
    self_paced: bool = True  # false: pspsl weighs by the priors alone
    options: dict[str, Options] = {}  # by policy, e.g. options.threshold.threshold = 0.3

    @model_validator(mode="before")
    @classmethod
    def _point_to_new_path(cls, section: Any) -> Any:
        if isinstance(section, Mapping) and "policy" in section:
            raise ValueError(f'policy has moved: write method = "{section["policy"]}" in [run]')
        return section


class TrainSection(Section):
    """How the detector learns."""

    preset: str = "auto"  # auto: the detector's first, see docs/config.md
    pretrain_steps: AtLeastOne = 1200
    round_steps: AtLeastOne = 1200
    batch_size: AtLeastOne = 2  # frames of X_l per step
    unlabeled_batch_size: Annotated[int, Field(ge=0)] = 2  # frames of X_u per step, besides
    learning_rate: Positive = 5e-3  # peak, from scratch
    round_learning_rate: Positive = 3e-3  # peak, from the teacher
    threads: AtLeastOne = 1
    zero_weight: Literal["method", "ignore", "background"] = "method"  # see docs/methods.md
    start: Literal["teacher", "scratch"] = "teacher"
    teacher: Literal["method", "student", "ema"] = "method"  # what teaches the next round
    ema_decay: Annotated[float, Field(ge=0, lt=1)] = 0.999  # per 1/10,000 of the training
    statistics_steps: AtLeastOne = 20  # between two points of the training's curves
    pasted: Annotated[int, Field(ge=0)] = 4  # of the object bank, per category; 0 = no bank
    command: str | None = None  # of your own trainer, see docs/training.md
    labels_format: str = "sqlite"  # in which it gets the labels; an exporter's name
    options: Options = {}


class RunSection(Section):
    """Which method learns, and how the work is organised."""

    method: str = "pspsl"  # see docs/methods.md
    rounds: AtLeastOne = 3
    seed: Seed = 0
    priors: Annotated[tuple[str, ...], AfterValidator(_each_once)] = DEFAULT_PRIORS
    prior_options: dict[str, Options] = {}  # of your own priors, by name
    executor: str = "serial"  # or process, ray; see docs/scale.md
    executor_options: dict[str, Options] = {}  # by executor, e.g. executor_options.ray.num_gpus = 1
    workers: AtLeastOne = 1
    database: str | None = None  # an SQLAlchemy URL; default: curate.db in the workspace


class Config(Section):
    """All sections."""

    dataset: DatasetSection
    detector: DetectorSection = DetectorSection()
    segmenter: SegmenterSection = SegmenterSection()
    repredict: RepredictSection = RepredictSection()
    points: PointsSection = PointsSection()
    semantic: SemanticSection = SemanticSection()
    solve: SolveSection = SolveSection()
    train: TrainSection = TrainSection()
    run: RunSection = RunSection()


def read_config(path: Path) -> Config:
    """The configuration in a TOML file.

    Raises:
        ConfigError: the file is not TOML, or some settings are wrong; all of them are named.
    """
    if path.exists() and not path.is_file():
        raise ConfigError(f"{path}: is no file but a folder, a pipe or a device; remove it")
    try:
        document = parse_toml(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file; `curate init` makes a workspace") from error
    except (RecursionError, ValueError) as error:  # ValueError: also of absurdly long numbers
        raise ConfigError(f"{path}: not TOML: {one_line(error, 200)}") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    return make_config(document, str(path))


def make_config(document: Mapping[str, Any], source: str) -> Config:
    """The configuration in a document.

    Raises:
        ConfigError: some settings are wrong; all of them are named, with their source.
    """
    try:
        return Config.model_validate(document)
    except ValidationError as error:
        faults = "; ".join(
            f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors()
        )
        raise ConfigError(f"{source}: {faults}") from error


def change_setting(document: dict[str, Any], setting: str) -> None:
    """Sets section.key=value in a document; the value as in TOML, anything else is a string.

    Raises:
        ConfigError: it is not of that form.
    """
    place, equals, text = setting.partition("=")
    *sections, key = place.strip().split(".")
    if not (equals and sections and key and all(sections)):
        raise ConfigError(f"--set {setting}: write section.key=value, e.g. solve.self_paced=false")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    for section in sections:
        if not isinstance(document.get(section), dict):
            document[section] = {}
        document = document[section]
    document[key] = value


def write_config(path: Path, config: Config) -> None:
    """Writes every setting as TOML, defaults included, so that a user sees what can be set."""
    document = config.model_dump(mode="json", exclude_none=True)
    lines = []
    for section, settings in document.items():
        lines += [f"[{section}]", *(f"{key} = {toml(value)}" for key, value in settings.items())]
        lines.append("")
    replace_file(path, "\n".join(lines).encode())


def toml(value: Any) -> str:
    """A value in TOML's notation."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)  # TOML's strings are escaped as JSON's are
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{toml(k)} = {toml(v)}' for k, v in value.items())}}}"
    return repr(value)
