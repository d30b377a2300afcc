"""From points to boxes with a loaded network: voxels, both stages, suppression."""

import numpy as np
import torch
from torch import Tensor

from curate.detections import Detections, as_categories
from curate.detectors.openpcdet.network import Batch, DetectionNetwork, FirstStage
from curate.detectors.openpcdet.roi_head import refine
from curate.detectors.openpcdet.schema import NMS
from curate.detectors.openpcdet.voxels import make_voxels
from curate.errors import ModelError
from curate.geometry.nms import nms_bev
from curate.geometry.similarity import wrap_angle
from curate.warnings_once import warn_once


def detect(
    network: DetectionNetwork, points: np.ndarray, minimum_score: float, place: str
) -> Detections:
    """Return the boxes of a sweep with at least a score, by descending score.

    Boxes suppress each other across classes, as the model file says. A lower minimum score only
    adds boxes: those with higher scores come first in the suppression.

    Args:
        network: in evaluation mode.
        points: (n, 4) points in the LiDAR frame.
        minimum_score: boxes with a lower score are left out.
        place: name of the frame, for messages.

    Raises:
        ModelError: if an output of the network is NaN or infinite.
    """
    voxels = make_voxels([points], network.file.data_config)
    if len(voxels.counts) == 0:
        warn_once(
            "some frames have no points in POINT_CLOUD_RANGE of the model file: they get no boxes"
        )
        return Detections.empty()
    if voxels.left_out[0]:
        cap = network.file.data_config.voxels.max_number_of_voxels.test
        warn_once(
            f"some frames have more voxels; the model file keeps {cap} (MAX_NUMBER_OF_VOXELS): "
            "points beyond them are not seen"
        )
    with torch.inference_mode():
        stage = network(Batch.of(voxels, network.anchors.device))
        _check_finite(place, stage.class_logits, stage.codes)
        if network.file.model.roi_head is None:
            boxes, scores, labels = _first_stage(network, stage, minimum_score)
        else:
            boxes, scores, labels = _second_stage(network, stage, minimum_score, place)
        found = boxes.double().cpu().numpy()
        confidence = scores.double().cpu().numpy()
        numbers = labels.cpu().numpy()
    kept = _suppressed(found, confidence, network.file.model.post_processing.nms_config)
    found = found[kept]
    found[:, 6] = wrap_angle(found[:, 6])
    names = network.file.class_names
    return Detections(found, confidence[kept], as_categories([names[i] for i in numbers[kept]]))


def proposals(
    network: DetectionNetwork, stage: FirstStage, frame: int, config: NMS
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the (r, 7) proposals of a frame, their (r,) classes and logits, by descending logit.

    OpenPCDet fills up to the full number with boxes of size 0 at the origin; curate does not.
    """
    logits, classes = stage.class_logits[frame].max(dim=1)
    index = _highest(logits, config.nms_pre_maxsize)
    boxes = network.boxes_of(stage, frame, index)
    rows = boxes.double().cpu().numpy()
    kept = torch.from_numpy(_suppressed(rows, logits[index].double().cpu().numpy(), config))
    kept = kept.to(index.device)
    best = index[kept]
    return boxes[kept], classes[best], logits[best]


def _first_stage(
    network: DetectionNetwork, stage: FirstStage, minimum_score: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return boxes, scores and classes of the best anchors."""
    logits, classes = stage.class_logits[0].max(dim=1)
    scores = torch.sigmoid(logits)
    enough = torch.nonzero(scores >= minimum_score)[:, 0]
    most = network.file.model.post_processing.nms_config.nms_pre_maxsize
    index = enough[_highest(scores[enough], most)]
    return network.boxes_of(stage, 0, index), scores[index], classes[index]


def _second_stage(
    network: DetectionNetwork, stage: FirstStage, minimum_score: float, place: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Return boxes, scores and classes of the refined proposals.

    The published score is that of the second stage, an estimate of the 3D IoU. After a short
    training it is too high for proposals on background, of which it has seen few. The score "both"
    is the geometric mean with the probability of the first stage.
    """
    rois, classes, first = proposals(network, stage, 0, network.roi_head.config.nms_config.test)
    frames = torch.zeros(len(rois), dtype=torch.int64, device=rois.device)
    logits, codes = network.roi_head(rois, frames, stage.levels)
    _check_finite(place, logits, codes)
    scores = torch.sigmoid(logits)
    if network.roi_head.config.score == "both":
        scores = (scores * torch.sigmoid(first)).sqrt()
    index = torch.nonzero(scores >= minimum_score)[:, 0]
    return refine(codes[index], rois[index]), scores[index], classes[index]


def _check_finite(place: str, *outputs: Tensor) -> None:
    """Raise ModelError if an output is NaN or infinite: its boxes would silently be left out."""
    if not all(bool(torch.isfinite(each).all()) for each in outputs):
        raise ModelError(
            f"frame {place}: the network computes NaN or infinite values; its weights are damaged, "
            "or too large"
        )


def _highest(scores: Tensor, most: int) -> Tensor:
    """Return the indices of the highest scores, in descending order; equal ones by index."""
    if len(scores) > most:
        least = torch.kthvalue(scores, len(scores) - most + 1)[0]
        enough = torch.nonzero(scores >= least)[:, 0]
        return enough[_highest(scores[enough], len(enough))][:most]
    return torch.sort(scores, descending=True, stable=True)[1]


def _suppressed(boxes: np.ndarray, scores: np.ndarray, config: NMS) -> np.ndarray:
    """Return the indices of the boxes that remain, by descending score."""
    if len(boxes) > config.nms_pre_maxsize:
        best = np.argsort(-scores, kind="stable")[: config.nms_pre_maxsize]
        return np.asarray(best[_suppressed(boxes[best], scores[best], config)])
    return nms_bev(boxes, scores, config.nms_thresh)[: config.nms_post_maxsize]
