"""What anchors and proposals learn: their objects, with the weights of these.

Sources: Yan, Mao and Li, "SECOND", Sensors 18(10), 2018 (anchors); Deng et al., "Voxel R-CNN", AAAI
2021, and Jiang et al., "Acquisition of Localization Confidence", ECCV 2018 (proposals).

Weights: an object has a weight v in [0, 1]. v multiplies all terms of the anchors and proposals
that learn the object. v = 0 is an ignore region: the anchors and proposals that would learn the
object learn nothing, and are not counted either.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from curate.detectors.openpcdet.anchors import encode, turned
from curate.detectors.openpcdet.kernels import match_rectangles
from curate.detectors.openpcdet.schema import ModelFile, ProposalSampling
from curate.geometry.overlap import iou_3d
from curate.shapes import Float, Float32, Int


@dataclass(frozen=True)
class Objects:
    """The m objects of a frame.

    Attributes:
        boxes: (m, 7) float32 in the LiDAR frame.
        classes: (m,) int64 number of the class in CLASS_NAMES, from 0.
        weights: (m,) float32 v.
    """

    boxes: Float32[np.ndarray, "m 7"]
    classes: Int[np.ndarray, " m"]
    weights: Float32[np.ndarray, " m"]


@dataclass(frozen=True)
class AnchorTargets:
    """What the a anchors of b frames learn.

    Attributes:
        weights: (b, a) weight in the classification: v, 1 for background, 0 if ignored.
        rows: (p,) frame and
        anchors: (p,) anchor of the p positives, those that learn an object.
        classes: (p,) class of their object.
        codes: (p, 7) box code of their object.
        yaws: (p,) yaw of their object in radians.
        counts: (b,) positives of each frame.
    """

    weights: Tensor
    rows: Tensor
    anchors: Tensor
    classes: Tensor
    codes: Tensor
    yaws: Tensor
    counts: Tensor


@dataclass(frozen=True)
class Matches:
    """The result of the assignment for the anchors of a frame.

    Attributes:
        labels: (a,) int64 class + 1 of the object, 0 for background, -1 if ignored.
        objects: (a,) int64 row of the object where the label is above 0.
    """

    labels: Int[np.ndarray, " a"]
    objects: Int[np.ndarray, " a"]


def match_anchors(
    anchors: Float32[np.ndarray, "a 7"],
    classes: Int[np.ndarray, " a"],
    file: ModelFile,
    objects: Objects,
) -> Matches:
    """Return which object each anchor learns.

    An anchor learns the object of its class that it overlaps most, if the nearest axis-aligned BEV
    IoU is at least `matched_threshold`. The anchors that overlap an object more than all other
    anchors do, learn as well, whatever their overlap. Below `unmatched_threshold` an anchor is
    background, in between it is ignored. All in float32: ties are frequent and all count.
    """
    labels = np.zeros(len(anchors), dtype=np.int64)
    matched = np.zeros(len(anchors), dtype=np.int64)
    for each in file.model.dense_head.anchor_generator_config:
        number = file.class_names.index(each.class_name)
        candidates = np.flatnonzero(objects.classes == number)
        if len(candidates) == 0:
            continue
        own = np.flatnonzero(classes == number)
        best, most, is_highest = match_rectangles(
            upright_rectangles(anchors[own]), upright_rectangles(objects.boxes[candidates])
        )
        positive = (most >= np.float32(each.matched_threshold)) | is_highest
        labels[own] = np.where(most < np.float32(each.unmatched_threshold), 0, -1)
        labels[own[positive]] = number + 1
        matched[own] = candidates[best]
    return Matches(labels, matched)


def anchor_targets(
    anchors: Float32[np.ndarray, "a 7"],
    classes: Int[np.ndarray, " a"],
    file: ModelFile,
    frames: Sequence[Objects],
    device: str | torch.device = "cpu",
) -> AnchorTargets:
    """Return what the anchors of frames learn.

    Args:
        anchors: all anchors.
        classes: class that each anchor is for, from 0.
        file: has the thresholds.
        frames: the objects of each frame.
        device: device of the result.
    """
    weights = np.empty((len(frames), len(anchors)), dtype=np.float32)
    parts: list[tuple[np.ndarray, ...]] = []
    for row, objects in enumerate(frames):
        found = match_anchors(anchors, classes, file, objects)
        positive = np.flatnonzero(found.labels > 0)
        trust = objects.weights[found.objects[positive]]
        weights[row] = found.labels == 0
        weights[row, positive] = trust
        positive = positive[trust > 0]
        index = found.objects[positive]
        parts.append(
            (np.full(len(positive), row), positive, objects.classes[index], objects.boxes[index])
        )
    rows, chosen, numbers, boxes = (
        torch.from_numpy(np.concatenate(each)) for each in zip(*parts, strict=True)
    )
    codes = encode(boxes, torch.from_numpy(anchors)[chosen])
    counts = torch.bincount(rows, minlength=len(frames))
    found_tensors = (torch.from_numpy(weights), rows, chosen, numbers, codes, boxes[:, 6], counts)
    return AnchorTargets(*(each.to(device) for each in found_tensors))


def upright_rectangles(boxes: Float32[np.ndarray, "n 7"]) -> Float32[np.ndarray, "n 4"]:
    """Return lowest and highest x, y of boxes turned to the nearest multiple of 90 degrees."""
    half_turn = np.float32(np.pi)
    yaw = np.abs(boxes[:, 6] - np.floor(boxes[:, 6] / half_turn + np.float32(0.5)) * half_turn)
    along_x = (yaw < np.float32(np.pi / 4))[:, None]
    sides = np.where(along_x, boxes[:, 3:5], boxes[:, [4, 3]])
    return np.concatenate([boxes[:, :2] - sides / 2, boxes[:, :2] + sides / 2], axis=1)


@dataclass(frozen=True)
class RoITargets:
    """What n sampled proposals of b frames learn.

    Attributes:
        rois: (n, 7) proposals.
        frames: (n,) int64.
        scores: (n,) target of the score: the 3D IoU with the object, stretched to [0, 1].
        weights: (n,) weight of the score: v of the object, 1 for background.
        refined: (f,) int64 rows of the proposals that learn a box.
        codes: (f, 7) box codes of their objects.
        boxes: (f, 7) boxes of their objects.
        box_weights: (f,) v of their objects.
    """

    rois: Tensor
    frames: Tensor
    scores: Tensor
    weights: Tensor
    refined: Tensor
    codes: Tensor
    boxes: Tensor
    box_weights: Tensor


def roi_targets(
    rois: Tensor,
    frames: Tensor,
    overlaps: Tensor,
    boxes: Tensor,
    trust: Tensor,
    config: ProposalSampling,
) -> RoITargets:
    """Return what proposals learn.

    Args:
        rois: (n, 7) proposals.
        frames: (n,) int64 frame of each.
        overlaps: (n,) 3D IoU with the object that each overlaps most.
        boxes: (n, 7) box of that object.
        trust: (n,) its weight v.
        config: thresholds.
    """
    low, high = config.cls_bg_thresh, config.cls_fg_thresh
    scores = ((overlaps - low) / (high - low)).clamp(0, 1)
    weights = torch.where(overlaps < low, 1.0, trust)
    refined = torch.nonzero(overlaps > config.reg_fg_thresh)[:, 0]
    chosen, own = boxes[refined], rois[refined]
    return RoITargets(
        rois, frames, scores, weights, refined,
        encode(_canonical(chosen, own), _at_origin(own)), chosen, trust[refined],
    )  # fmt: skip


def _canonical(boxes: Tensor, rois: Tensor) -> Tensor:
    """Return (f, 7) boxes in the frames of proposals, with a yaw in [-pi/2, pi/2].

    A proposal with the opposite heading keeps it: the second stage does not turn boxes round.
    """
    centres = turned((boxes[:, :3] - rois[:, :3])[:, None], rois[:, 6], "back")[:, 0]
    full = 2 * torch.pi
    yaw = (boxes[:, 6] - rois[:, 6] % full) % full
    opposite = (yaw > torch.pi / 2) & (yaw < 3 * torch.pi / 2)
    yaw = torch.where(opposite, (yaw + torch.pi) % full, yaw)
    yaw = torch.where(yaw > torch.pi, yaw - full, yaw).clamp(-torch.pi / 2, torch.pi / 2)
    return torch.cat([centres, boxes[:, 3:6], yaw[:, None]], dim=1)


def _at_origin(rois: Tensor) -> Tensor:
    """Return (f, 7) proposals with their centre and yaw at 0."""
    zero = torch.zeros_like(rois[:, :3])
    return torch.cat([zero, rois[:, 3:6], zero[:, :1]], dim=1)


def sample_rois(
    rois: Tensor, classes: Tensor, frame: int, objects: Objects, config: ProposalSampling
) -> RoITargets:
    """Return a sample of a frame's proposals and what they learn.

    Up to FG_RATIO of the sample overlap an object well; most of the others overlap one a little.
    Random numbers come from torch's global generator, as in a `Student`'s loss.

    Args:
        rois: (r, 7) proposals.
        classes: (r,) their classes, from 0.
        frame: number of the frame in the batch.
        objects: the objects of the frame.
        config: number, shares and thresholds.
    """
    overlaps, matched = _best_objects(rois, classes, objects, config)
    trust = np.append(objects.weights, np.float32(1))[matched]
    # Proposals at an ignore region learn nothing.
    usable = np.flatnonzero((trust > 0) | (overlaps < config.cls_bg_thresh_lo))
    index = usable[_sampled(overlaps[usable], config)]
    boxes = np.concatenate([objects.boxes, np.zeros((1, 7), np.float32)])[matched[index]]
    device = rois.device
    return roi_targets(
        rois[torch.from_numpy(index).to(device)],
        torch.full((len(index),), frame, device=device),
        torch.from_numpy(overlaps[index].astype(np.float32)).to(device),
        torch.from_numpy(boxes).to(device),
        torch.from_numpy(trust[index]).to(device),
        config,
    )


def _best_objects(
    rois: Tensor, classes: Tensor, objects: Objects, config: ProposalSampling
) -> tuple[Float[np.ndarray, " r"], Int[np.ndarray, " r"]]:
    """Return the highest 3D IoU of each proposal with an object, and that object's row.

    The row is the number of objects where there is none.
    """
    overlaps = np.zeros(len(rois))
    matched = np.full(len(rois), len(objects.classes))
    if len(rois) == 0 or len(objects.classes) == 0:
        return overlaps, matched
    table = iou_3d(rois.detach().double().cpu().numpy(), objects.boxes.astype(np.float64))
    if config.sample_roi_by_each_class:
        table[classes.cpu().numpy()[:, None] != objects.classes] = 0
    overlaps = table.max(axis=1)
    return overlaps, np.where(overlaps > 0, table.argmax(axis=1), matched)


def _sampled(overlaps: np.ndarray, config: ProposalSampling) -> np.ndarray:
    """Return (n,) rows of the sampled proposals: all equally likely within each group."""
    total = config.roi_per_image
    good = np.flatnonzero(overlaps >= min(config.reg_fg_thresh, config.cls_fg_thresh))
    poor = np.flatnonzero(overlaps < config.reg_fg_thresh)
    hard = poor[overlaps[poor] >= config.cls_bg_thresh_lo]
    easy = poor[overlaps[poor] < config.cls_bg_thresh_lo]
    if len(good) and len(poor):
        good = good[torch.randperm(len(good)).numpy()[: round(config.fg_ratio * total)]]
    elif len(good):
        good = _drawn(good, total)
    rest = total - len(good)
    hard_count = min(int(rest * config.hard_bg_ratio), len(hard)) if len(easy) else rest
    return np.concatenate([good, _drawn(hard, hard_count), _drawn(easy, rest - hard_count)])


def _drawn(rows: np.ndarray, count: int) -> np.ndarray:
    """Return random rows, with repetition; none if there are none."""
    if len(rows) == 0 or count <= 0:
        return np.zeros(0, dtype=np.int64)
    return np.asarray(rows[torch.randint(len(rows), (count,)).numpy()])


def joined(parts: Sequence[RoITargets]) -> RoITargets:
    """Return the targets of several frames as one."""
    starts = np.cumsum([0, *(len(each.rois) for each in parts)]).tolist()
    shifted = [each.refined + start for each, start in zip(parts, starts, strict=False)]

    def cat(name: str) -> Tensor:
        return torch.cat([getattr(each, name) for each in parts])

    return RoITargets(
        cat("rois"), cat("frames"), cat("scores"), cat("weights"), torch.cat(shifted),
        cat("codes"), cat("boxes"), cat("box_weights"),
    )  # fmt: skip
