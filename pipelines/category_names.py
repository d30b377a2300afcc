"""Category names of label files, detector, segmenter and settings, compared before work starts.

The ground truth of unlabeled frames is never read for it: only the stored names of X_l and val.
"""

import logging
from collections.abc import Callable, Collection, Iterable, Mapping

from sqlalchemy import func, select

from curate.category_names import NamedSide, NameFinding, compare_names
from curate.datasets.kitti.labels import DONT_CARE
from curate.detectors.base import Detector, NamesCategories
from curate.errors import ConfigError, CurateError
from curate.spelling import did_you_mean
from curate.warnings_once import warn_once
from db import bulk
from db.models import BOX_COLUMNS
from pipelines import registry
from pipelines.assembly import check_segmenter_names, open_detector
from pipelines.workspace.config import Config
from pipelines.workspace.setup import label_names
from pipelines.workspace.workspace import Workspace, open_dataset

_log = logging.getLogger(__name__)


def check_names(workspace: Workspace) -> None:
    """Compare the names that are known without a detector, at the start of a command.

    If `dataset.rename` has changed, the stored ground truth is renamed first.

    Raises:
        ConfigError: if names differ so that no work can start.
    """
    _rename_stored(workspace)
    report(find_differences(workspace))


def find_differences(workspace: Workspace) -> list[NameFinding]:
    """Return the differences between label files, segmenter and settings; nothing is changed."""
    config = workspace.config
    side = label_names(config, stored_names(workspace), original=False)
    findings = compare_names(side, config.dataset.categories)
    return [*findings, *_settings(config), *_segmenter(config)]


def check_detector_names(config: Config, detector: Detector) -> None:
    """Compare the names that a detector returns, if it knows them before it sees a frame.

    Raises:
        ConfigError: if they differ so that no work can start.
    """
    report(detector_differences(config, detector), warn=warn_once)


def detector_differences(config: Config, detector: Detector) -> list[NameFinding]:
    """Return the differences between a detector's names and `dataset.categories`."""
    if not isinstance(detector, NamesCategories):
        return []
    from curate.detectors.recorded import RecordedDetector

    names, title = sorted(detector.category_names()), "the detector's outputs"
    rename = config.detector.rename or {}
    if isinstance(detector, RecordedDetector):
        of_path = detector.names_by_path()
        if not names:
            message = f"the results {detector.path} have no boxes: every frame will be empty"
            return [NameFinding(False, message)]
        # The results with a name that is not a category: perhaps only those of a view.
        known = {*config.dataset.categories, *rename}
        path = next((path for path, own in of_path.items() if own - known), detector.path)
        title = f"the results {path}"
    side = NamedSide(title, names, "detector.rename", rename)
    return compare_names(side, config.dataset.categories)


def check_before_init(config: Config) -> Detector | None:
    """Compare the names of settings, segmenter and a user-supplied detector with each other.

    Returns:
        The detector, if it has a file and could be opened.

    Raises:
        ConfigError: if names differ so that no work can start.
    """
    detector, differences = _supplied_detector(config)
    report([*_settings(config), *_segmenter(config), *differences])
    return detector


def report(findings: Iterable[NameFinding], warn: Callable[[str], None] = _log.warning) -> None:
    """Log the findings as warnings.

    Raises:
        ConfigError: if one is wrong; the message has all that are.
    """
    wrong = []
    for finding in findings:
        if finding.wrong:
            wrong.append(finding.message)
        else:
            warn(finding.message)
    if wrong:
        raise ConfigError("; ".join(wrong))


def all_differences(workspace: Workspace) -> list[NameFinding]:
    """Return the differences between all sides, the detector included; nothing is changed."""
    return [*find_differences(workspace), *_supplied_detector(workspace.config)[1]]


def _supplied_detector(config: Config) -> tuple[Detector | None, list[NameFinding]]:
    """Return a detector with a file of the user, if its class knows names, and its differences.

    A detector that cannot be opened is a warning: the commands that need it report it as an error.
    """
    path = config.detector.path
    if path is None or not hasattr(registry.DETECTORS.load(config.detector.name), "category_names"):
        return None, []
    open_dataset(config).frame_ids()  # an error of the data set is not one of the detector
    try:
        detector = open_detector(config, path)
        return detector, detector_differences(config, detector)
    except CurateError as error:
        return None, [NameFinding(False, str(error))]


def stored_names(workspace: Workspace) -> Mapping[str, int]:
    """Return the number of stored objects of X_l and val by category, sorted by name."""
    truth = bulk.table("ground_truth")
    query = select(truth.c.category, func.count()).group_by(truth.c.category)
    return dict(sorted(workspace.database.rows(query)))


def _rename_stored(workspace: Workspace) -> None:
    """Rename the stored ground truth, if `dataset.rename` has changed since it was read."""
    rename = workspace.config.dataset.rename or {}
    stored = stored_names(workspace)
    changes = {name: rename[name] for name in stored if rename.get(name, name) != name}
    if not changes:
        return
    truth = bulk.table("ground_truth")
    no_box = dict.fromkeys(BOX_COLUMNS)
    with workspace.database.writing() as connection:
        for name, target in changes.items():
            values = {"category": target, **(no_box if target == DONT_CARE else {})}
            connection.execute(truth.update().where(truth.c.category == name).values(**values))
            _log.warning("%d objects %s are %s now (dataset.rename)", stored[name], name, target)


def _settings(config: Config) -> list[NameFinding]:
    """Return findings for categories in the options of policies that do not exist."""
    categories = config.dataset.categories
    return [
        NameFinding(
            False,
            f"solve.options.{policy}.{key}: {name!r} is not in dataset.categories "
            f"({', '.join(categories)}){did_you_mean(name, categories)}",
        )
        for policy, options in config.solve.options.items()
        for key, values in options.items()
        if key.endswith("per_category") and isinstance(values, Mapping)
        for name in _unknown(values, categories)
    ]


def _unknown(names: Collection[str], categories: Collection[str]) -> list[str]:
    return [name for name in names if name not in categories]


def _segmenter(config: Config) -> list[NameFinding]:
    """Return a finding if a prior counts pixels of a category without classes."""
    if not any(registry.PRIORS.takes(name, "segmenter") for name in config.run.priors):
        return []
    try:
        check_segmenter_names(config)
    except ConfigError as error:
        return [NameFinding(True, str(error))]
    return []
