"""Check one frame from end to end: data set, detector, augmented views, segmenter."""

import itertools
import logging
from collections.abc import Callable, Sequence

import numpy as np

from curate.category_names import NameFinding, renamed
from curate.detections import Detections
from curate.detectors.base import CopiesDetector, Detector, RecordedViews
from curate.detectors.recorded import RecordedDetector
from curate.errors import ConfigError, CurateError
from curate.evaluation.camera_examination import examine_camera
from curate.evaluation.examination import Finding, examine_detections, examine_frame
from curate.evaluation.heading_examination import examine_headings
from curate.evaluation.label_examination import examine_labels
from curate.frames import Frame
from curate.geometry.augmented_views import augmented_frame
from curate.segmenters.base import Segmenter, image_size_of
from pipelines.assembly import (
    Place,
    check_detector,
    check_segmenter,
    check_training_options,
    open_detector,
    open_segmenter,
    wants_views,
)
from pipelines.assessment.missing_results import describe_missing_results
from pipelines.category_names import detector_differences, find_differences
from pipelines.devices import detector_place, idle_gpu, segmenter_place
from pipelines.engine.rounds import (
    choose_round,
    is_student_trained,
    is_trainable,
    newest_checkpoint,
)
from pipelines.labels.of_one_frame import find_frame
from pipelines.stages import calibrate
from pipelines.stages.calibration_frames import check_truth, choose_source
from pipelines.stages.labeled_copies import (
    TURNED,
    examine_labeled_copies,
    labeled_frames,
)
from pipelines.stages.predict import checked, visible
from pipelines.workspace.config import Config
from pipelines.workspace.images import check_reference
from pipelines.workspace.splits import HELD_OUT, SPLITS, WITH_TRUTH
from pipelines.workspace.workspace import Workspace, read_truth

_log = logging.getLogger(__name__)

# Labeled frames whose labels are checked together.
_LABELED_FRAMES = 5
# Frames with recorded results that are checked together with the frame.
_RESULT_FRAMES = 4


def examine(workspace: Workspace, frame_id: str | None) -> tuple[str, list[Finding]]:
    """Return the name of the checked frame and the findings; nothing is stored.

    Args:
        workspace: see `Workspace`.
        frame_id: any name of the frame to check; None for the first unlabeled frame.

    Raises:
        ConfigError: if no frame of the workspace has that name, or several have.
    """
    names = list(workspace.frames(*SPLITS))
    unlabeled = list(workspace.frames("unlabeled"))
    if not names:
        raise ConfigError(f"doctor: the workspace {workspace.root} has no frames")
    name = find_frame(workspace, frame_id) if frame_id else (unlabeled or names)[0]
    semantic = "semantic" in workspace.config.run.priors
    try:
        frame = workspace.dataset.read(name, image=semantic)
    except CurateError as error:
        return name, [Finding("data set", "wrong", str(error))]
    findings = [*_guarded("devices", lambda: _devices(workspace, semantic=semantic))]
    findings += _guarded("training", lambda: _training(workspace.config))
    findings += [*_names(find_differences(workspace)), *examine_frame(frame)]
    findings += examine_camera(frame)
    findings += _guarded("labels", lambda: _labels(workspace, frame))
    findings += _guarded("detector", lambda: _detector(workspace, frame))
    findings += _guarded("probabilities", lambda: _probabilities(workspace))
    if semantic:
        findings += _guarded("segmenter", lambda: _segmenter(workspace, frame))
    return name, findings


def report_wrong_inputs(workspace: Workspace) -> None:
    """Log what is wrong with the label files and the semantic maps, from a few frames.

    The detector is left out: results are compared when they are opened, and models take time.
    """
    name = next(iter(workspace.frames(*SPLITS)), None)
    if name is None:
        return
    semantic = "semantic" in workspace.config.run.priors
    try:
        frame = workspace.dataset.read(name, image=semantic)
    except CurateError:
        return  # the frames that cannot be read are reported by their own check
    findings = [*_guarded("labels", lambda: _labels(workspace, frame))]
    findings += _guarded("probabilities", lambda: _probabilities(workspace))
    if semantic:
        findings += _guarded("segmenter", lambda: _segmenter(workspace, frame))
    for finding in findings:
        if finding.state == "wrong":
            _log.warning("%s: %s; see `curate doctor`", finding.check, finding.message)


def _devices(workspace: Workspace, *, semantic: bool) -> Sequence[Finding]:
    """Report where the models run."""
    config = workspace.config
    check_detector(config, workspace.root)
    if semantic:
        check_segmenter(config)
    places = {"detector": detector_place(config)}
    if semantic:
        places["segmenter"] = segmenter_place(config)
    used = "; ".join(f"{model} in {place}" for model, place in places.items() if place)
    if idle_gpu(*places.values()):
        used += "; the NVIDIA GPU of this machine is not used, see docs/install.md#gpus"
    return [Finding("devices", "ok", used or "no model runs here")]


def _training(config: Config) -> Sequence[Finding]:
    """Check the settings of curate's trainer; there is nothing to report if they are valid."""
    check_training_options(config)
    return []


def _probabilities(workspace: Workspace) -> Sequence[Finding]:
    """Check that the method has frames to learn probabilities from, if it reads any."""
    method = workspace.config.run.method
    if not calibrate.applies(workspace, method):
        return []
    number, rounds = choose_round(workspace, None, None)
    last = rounds if is_student_trained(workspace) else number
    check_truth(workspace, method, range(number, last + 1))
    source = choose_source(workspace, number)
    split = "labeled" if source == "folds" else source
    frames = f"{len(workspace.frames(split))} {split} frames"
    message = f"learned from {'folds of ' if source == 'folds' else ''}{frames}"
    return [Finding("probabilities", "ok", message)]


def _guarded(name: str, check: Callable[[], Sequence[Finding]]) -> Sequence[Finding]:
    """Return the findings of a check, or its error as a finding."""
    try:
        return check()
    except CurateError as error:
        return [Finding(name, "wrong", str(error))]


def _labels(workspace: Workspace, frame: Frame) -> Sequence[Finding]:
    """Check the labels of some labeled frames, with those of the frame itself if it has any."""
    others = [name for name in workspace.frames(*WITH_TRUTH) if name != frame.frame_id]
    own = len(others) < len(workspace.frames(*WITH_TRUTH))
    dataset = workspace.dataset
    frames = [frame] if own else []
    frames += [dataset.read(name) for name in others[: _LABELED_FRAMES - len(frames)]]
    if not frames:
        return []
    truth = (read_truth(workspace.config, dataset, each.frame_id) for each in frames)
    return examine_labels(list(zip(frames, truth, strict=True)))


def _detector(workspace: Workspace, frame: Frame) -> Sequence[Finding]:
    config = workspace.config
    number, _ = choose_round(workspace, None, None)
    split = next(each for each in SPLITS if frame.frame_id in workspace.frames(each))
    place = Place(workspace.root, number, copies=split)
    detector = open_detector(config, newest_checkpoint(workspace), place)
    missing = describe_missing_results(workspace, detector)
    seen = visible(frame, config)
    found = renamed(detector.predict(seen), config.detector.rename)
    findings = [
        *_names(detector_differences(config, detector)),
        *([Finding("results", "suspect", missing)] if missing else []),
        *examine_detections(
            seen,
            found,
            config.dataset.categories,
            _other_results(workspace, detector, frame),
            trainable=is_trainable(workspace),
        ),
    ]
    findings += _headings(workspace, detector)
    checked(found, config, detector)
    if isinstance(detector, RecordedDetector) and detector.lacks_copy(frame.frame_id):
        findings.append(Finding("views", "ok", "the augmented copies are those of another split"))
    elif isinstance(detector, CopiesDetector):
        findings += _copies(workspace, detector, seen, found)
    elif isinstance(detector, RecordedViews):
        views = detector.views(frame.frame_id)
        empty = len(found) > 0 and not any(len(detections) for _, detections in views)
        recorded = f"{len(views)} recorded augmented copies of this frame"
        findings.append(
            _no_views(config)
            if not views
            else Finding("views", "suspect", f"{recorded}, but no box in any of them")
            if empty
            else Finding("views", "ok", recorded)
        )
        for similarity, detections in views:
            augmented = augmented_frame(seen, similarity)
            findings += [
                finding
                for finding in examine_detections(augmented, detections, ())
                if finding.check == "boxes" and finding.state == "wrong"
            ]
    return findings


def _copies(
    workspace: Workspace, detector: CopiesDetector, frame: Frame, found: Detections
) -> list[Finding]:
    """Run a detector that runs elsewhere on turned copies of the frame and of labeled frames."""
    config = workspace.config
    labeled = [name for name in labeled_frames(workspace) if name != frame.frame_id]
    [copy, *others] = detector.predict_copies(
        dict.fromkeys([frame.frame_id, *labeled], TURNED), view=1
    )
    if isinstance(copy, CurateError):
        return [Finding("views", "wrong", str(copy))]
    copy = renamed(copy, config.detector.rename)
    if len(found) and np.array_equal(copy.boxes, found.boxes):
        message = (
            "the boxes of a turned copy are those of the frame: the command must read the frames "
            "in {data} or {clouds}, not the data set"
        )
        return [Finding("views", "wrong", message)]
    wrong = [
        finding
        for finding in examine_detections(augmented_frame(frame, TURNED), copy, ())
        if finding.check == "boxes" and finding.state == "wrong"
    ]
    state = "ok" if len(copy) or not len(found) else "suspect"
    message = f"{len(copy)} boxes in a turned copy of this frame, {len(found)} in the frame"
    views = wrong or [Finding("views", state, message)]
    usable = {
        name: checked(each, config)
        for name, each in zip(labeled, others, strict=True)
        if not isinstance(each, CurateError)
    }
    problem, findings = examine_labeled_copies(config, workspace.dataset, detector, usable)
    if problem:
        return [*views, Finding("headings", "wrong", problem)]
    few = f"not compared: the command finds too few objects of {len(usable)} labeled frames"
    return [*views, *(findings or [Finding("headings", "ok", few)])]


def _other_results(
    workspace: Workspace, detector: Detector, frame: Frame
) -> list[tuple[Frame, Detections]]:
    """Return some more frames with recorded results, which cost nothing to compute."""
    found: list[tuple[Frame, Detections]] = []
    names = (name for name in workspace.frames("unlabeled", *HELD_OUT) if name != frame.frame_id)
    if not isinstance(detector, RecordedDetector):
        return found
    for name in itertools.islice(names, _RESULT_FRAMES):
        try:
            other = visible(workspace.dataset.read(name, image=False), workspace.config)
            result = renamed(detector.predict(other), workspace.config.detector.rename)
        except CurateError:
            continue  # the frame fails later, with its own error
        found.append((other, result))
    return found


def _headings(workspace: Workspace, detector: Detector) -> list[Finding]:
    """Compare recorded results of labeled and val frames with the ground truth."""
    names = list(workspace.frames(*WITH_TRUTH))
    if not isinstance(detector, RecordedDetector):
        return []
    recorded = sorted({*names} - {*detector.missing_frames(names)})[:_LABELED_FRAMES]
    pairs = []
    for name in recorded:
        try:
            frame = workspace.dataset.read(name, points=False)
            found = renamed(detector.predict(frame), workspace.config.detector.rename)
        except CurateError:
            continue  # the frame fails later, with its own error
        pairs.append((found, read_truth(workspace.config, workspace.dataset, name)))
    return examine_headings(pairs)


def _names(differences: Sequence[NameFinding]) -> list[Finding]:
    """Return differences between category names as findings."""
    return [
        Finding("names", "wrong" if each.wrong else "suspect", each.message) for each in differences
    ]


def _no_views(config: Config) -> Finding:
    """Return the finding for recorded detections without augmented views."""
    if not wants_views(config):
        return Finding("views", "ok", "none recorded; the weights come from the priors only")
    return Finding(
        "views",
        "suspect",
        "no second pass over augmented copies, so no label has a consistency loss: write them with "
        "`curate augment` and set detector.augmented, or set solve.self_paced = false",
    )


def _segmenter(workspace: Workspace, frame: Frame) -> Sequence[Finding]:
    check_reference(workspace.config, workspace.frames("labeled"))
    segmenter = open_segmenter(workspace.config)
    return [found for view in frame.views() for found in _map(workspace, segmenter, view)]


def _map(workspace: Workspace, segmenter: Segmenter, view: Frame) -> Sequence[Finding]:
    """Check the semantic map of a frame with one camera."""
    found = segmenter.segment(view)
    width, height = image_size_of(view)
    if found.class_ids.shape != (height, width):
        shape = list(found.class_ids.shape)
        message = f"the map is {shape}, the image [{height}, {width}]"
        return [Finding("segmenter", "wrong", message)]
    categories = workspace.config.dataset.categories
    missing = [name for name in categories if name not in found.category_classes]
    if missing:
        message = f"no class is mapped to {', '.join(missing)}; see segmenter.classes"
        return [Finding("segmenter", "wrong", message)]
    shares = {
        name: float(np.isin(found.class_ids, found.category_classes[name]).mean())
        for name in categories
    }
    summary = ", ".join(f"{name} {share:.1%}" for name, share in shares.items())
    state = "ok" if any(shares.values()) else "suspect"
    camera = f"{view.camera}: " if view.camera else ""
    return [Finding("segmenter", state, f"{camera}share of the pixels: {summary}")]
