"""The images of a data set, and what follows for the settings if there are none."""

import logging
from collections.abc import Collection, Sequence

from curate.datasets.base import Dataset, Incomplete
from curate.errors import ConfigError, DataError
from pipelines import registry
from pipelines.workspace.config import Config

_log = logging.getLogger(__name__)

_SEMANTIC = "semantic"


def fit_priors(config: Config, dataset: Dataset, *, explicit: bool) -> Config:
    """Return the configuration without the semantic prior if the data set cannot have it.

    Args:
        config: the configuration.
        dataset: its data set.
        explicit: whether the user chose the priors; they are then not changed.

    Raises:
        ConfigError: if the user chose the semantic prior for such a data set.
    """
    reason = why_not_segmented(config, dataset)
    if _SEMANTIC not in config.run.priors or not reason:
        return config
    if explicit:
        raise ConfigError(f"run.priors: {reason}; leave 'semantic' out")
    priors = tuple(name for name in config.run.priors if name != _SEMANTIC)
    _log.warning("%s: run.priors = [%s]", reason, ", ".join(f'"{name}"' for name in priors))
    return config.model_copy(update={"run": config.run.model_copy(update={"priors": priors})})


def check_segmentable(config: Config, dataset: Dataset) -> None:
    """Check that the frames have what the configured segmenter needs.

    Raises:
        ConfigError: if they have not.
    """
    if reason := why_not_segmented(config, dataset):
        raise ConfigError(f"run.priors: {reason}; leave 'semantic' out of run.priors")


def why_not_segmented(config: Config, dataset: Dataset) -> str:
    """Return why the segmenter cannot segment the frames; "" if it can."""
    first = next(iter(dataset.frame_ids()), None)
    if first is None or dataset.files(first).images:
        return ""
    if not _has_camera(dataset, first):
        return "the data set has no camera, so the semantic prior cannot be computed"
    name = "onnx" if config.segmenter.name == "simulated" else config.segmenter.name
    if name != "none" and registry.SEGMENTERS.declared(name, "needs_image"):
        return f"the data set has no images, which segmenter '{config.segmenter.name}' needs"
    return ""


def _has_camera(dataset: Dataset, frame: str) -> bool:
    """Return whether a frame has a camera; a damaged frame, which fails later, counts as one."""
    try:
        return bool(dataset.read(frame, points=False).cameras)
    except DataError:
        return True


def report_images(config: Config, dataset: Dataset, frames: Sequence[str]) -> None:
    """Log a warning for frames with missing images, and for a data set without any image."""
    if isinstance(dataset, Incomplete) and (skipped := dataset.skipped_frames()):
        _log.warning("%s: %s", config.dataset.root, skipped)
    if not frames:
        return
    images = {frame: dataset.files(frame).images for frame in frames}
    missing = [path for paths in images.values() for path in paths if not path.exists()]
    if missing:
        _log.warning(
            "%d images are missing, such as %s: their frames fail in every stage; fetch the files "
            "again, or leave the frames out",
            len(missing),
            missing[0],
        )
    if images[frames[0]]:
        return
    pictures = "pictures show the bird's eye view alone"
    if _has_camera(dataset, frames[0]):
        _log.warning("%s: no images: %s", config.dataset.root, pictures)
        return
    crop = ""
    if config.detector.camera_view:
        crop = (
            ", and the detector gets the points all around; if it needs those in the camera's view "
            "(detector.camera_view), set image_size, see docs/datasets.md"
        )
    _log.warning("%s: no images and no image_size: %s%s", config.dataset.root, pictures, crop)


def check_reference(config: Config, labeled: Collection[str]) -> None:
    """Check that there are labeled frames if `semantic.reference` compares labels with them.

    Args:
        config: the configuration.
        labeled: names of the labeled frames.

    Raises:
        ConfigError: if there are none.
    """
    if config.semantic.reference and "semantic" in config.run.priors and not labeled:
        raise ConfigError(
            "semantic.reference = true compares S/A with labeled boxes, but there are no labeled "
            "frames; label some, or set semantic.reference = false"
        )
