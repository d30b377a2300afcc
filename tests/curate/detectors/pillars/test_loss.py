"""The weighted loss, with numbers worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from curate.detectors.pillars.encoding import BOX_CODE, encode_boxes
from curate.detectors.pillars.loss import (
    BatchTargets,
    box_loss,
    heatmap_loss,
    iou_loss,
    weighted_loss,
)
from curate.detectors.pillars.network import NetworkOutput
from curate.detectors.pillars.presets import PRESETS

PRESET = replace(PRESETS["small"], x_range=(0.0, 20.48), y_range=(-10.24, 10.24))
CAR = [10.0, 0.0, -0.8, 4.0, 1.6, 1.5, 0.3]


def targets_of(*frames):
    """Return targets of frames, each a list of (box, weight), of one category."""
    return BatchTargets.stack(
        [
            encode_boxes(
                np.array([box for box, _ in frame]).reshape(-1, 7),
                np.zeros(len(frame), dtype=int),
                np.array([weight for _, weight in frame]),
                1,
                PRESET,
            )
            for frame in frames
        ]
    )


def random_outputs(frames=1, seed=0):
    """Return random outputs that require gradients."""
    generator = torch.Generator().manual_seed(seed)
    parts = [
        torch.randn(frames, *PRESET.cells, *more, generator=generator, dtype=torch.float64)
        for more in ((1,), (BOX_CODE,), ())
    ]
    return NetworkOutput(*(part.requires_grad_() for part in parts))


def gradients(targets, seed=0, frames=1):
    """Return the gradients of the whole loss."""
    given = random_outputs(frames, seed)
    weighted_loss(given, targets, PRESET, 1.0)["loss"].backward()
    return NetworkOutput(*(part.grad for part in given))


def test_background_only():
    """Without objects each of the 32 x 32 cells at p = 1/2 adds 1/4 * ln 2."""
    logits = torch.zeros(1, *PRESET.cells, 1)
    expected = 32 * 32 * 0.25 * math.log(2)
    assert float(heatmap_loss(logits, targets_of([]))) == pytest.approx(expected, rel=1e-5)


def test_a_centre_adds_its_focal_term_times_v():
    """At p = 1/4 the centre of an object adds v * (3/4)^2 * ln 4, more than an ignored one."""
    logits = torch.full((1, *PRESET.cells, 1), math.log(1 / 3), dtype=torch.float64)
    kept = targets_of([(CAR, 0.5)])
    silent = replace(kept, weights=torch.zeros(1))
    difference = heatmap_loss(logits, kept) - heatmap_loss(logits, silent)
    assert float(difference) == pytest.approx(0.5 * 0.75**2 * math.log(4))


def test_the_box_term_is_l1_times_v():
    """All codes wrong by 1/2 in each of their entries cost v * BOX_CODE / 2."""
    targets = targets_of([(CAR, 0.25)])
    codes = torch.zeros(1, *PRESET.cells, BOX_CODE)
    codes.flatten(0, 2)[targets.code_cells] = targets.codes + 0.5
    assert float(box_loss(codes, targets)) == pytest.approx(0.25 * BOX_CODE / 2, rel=1e-5)


def test_the_iou_term_is_least_at_the_true_overlap():
    """A box moved half its length along itself overlaps by 1/3.

    Predicting 1/3 costs its entropy.
    """
    straight = [*CAR[:6], 0.0]
    targets = targets_of([(straight, 0.5)])
    codes = torch.zeros(1, *PRESET.cells, BOX_CODE, dtype=torch.float64)
    moved = targets.codes.double().clone()
    moved[:, 0] += straight[3] / 2 / PRESET.cell_m
    codes.flatten(0, 2)[targets.code_cells] = moved

    silent = torch.full((1, *PRESET.cells, 1), -9.0)

    def loss(predicted):
        logits = torch.full(
            (1, *PRESET.cells), math.log(predicted / (1 - predicted)), dtype=torch.float64
        )
        return float(iou_loss(NetworkOutput(silent, codes, logits), targets, PRESET))

    entropy = -(math.log(1 / 3) / 3 + 2 * math.log(2 / 3) / 3)
    assert loss(1 / 3) == pytest.approx(0.5 * entropy, rel=1e-4)
    assert loss(0.3) > loss(1 / 3) < loss(0.36)


def test_the_iou_term_does_not_move_the_box():
    """The overlap is a target: the gradient reaches only the estimate, in every frame."""
    targets = targets_of([(CAR, 1.0)], [(CAR, 1.0)])
    given = random_outputs(2)
    iou_loss(given, targets, PRESET).backward()
    assert given.codes.grad is None
    assert given.logits.grad is None
    assert (given.iou_logits.grad.flatten(1).abs().sum(1) > 0).all()


def test_a_false_positive_has_target_iou_zero():
    """A false detection costs ln 2 / 9 at IoU 1/2; in an ignored region nothing."""
    silent = torch.full((1, *PRESET.cells, 1), -9.0)
    codes, undecided = torch.zeros(1, *PRESET.cells, BOX_CODE), torch.zeros(1, *PRESET.cells)
    ignored = targets_of([(CAR, 0.0)])
    far = (2, 2)
    for cell, expected in ((far, math.log(2) / 9), (divmod(int(ignored.centres[0]), 32), 0.0)):
        found = silent.clone()
        found[0, *cell, 0] = 0.0
        cost = iou_loss(NetworkOutput(found, codes, undecided), ignored, PRESET)
        assert float(cost) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("v", [0.1, 0.5])
def test_the_gradient_of_an_object_is_scaled_by_v(v):
    """In the object's region every gradient is scaled by v, outside nothing changes."""
    sure, unsure = targets_of([(CAR, 1.0)]), targets_of([(CAR, v)])
    region = (unsure.background < 1)[0, ..., 0]
    logits_sure, codes_sure, ious_sure = gradients(sure)
    logits_unsure, codes_unsure, ious_unsure = gradients(unsure)
    torch.testing.assert_close(logits_unsure[0][region], v * logits_sure[0][region])
    torch.testing.assert_close(logits_unsure[0][~region], logits_sure[0][~region])
    torch.testing.assert_close(codes_unsure, v * codes_sure)
    torch.testing.assert_close(ious_unsure[0][region], v * ious_sure[0][region])
    assert codes_sure.abs().sum() > 0
    assert ious_sure[0][region].abs().sum() > 0


def test_an_ignored_region_has_no_gradient():
    """Neither as object nor as background."""
    targets = targets_of([(CAR, 0.0)])
    logits, codes, ious = gradients(targets)
    region = (targets.background == 0)[0, ..., 0]
    assert int(region.sum()) >= 15
    assert not logits[0][region].any()
    assert logits[0][~region].abs().min() > 0
    assert not codes.any()
    assert not ious[0][region].any()


def test_the_weights_of_other_objects_do_not_matter():
    """The gradient of an object is not divided by a sum of weights."""
    other = [10.0, 7.0, *CAR[2:]]
    alone = gradients(targets_of([(CAR, 1.0)], []), frames=2)[1]
    for weight in (0.0, 0.3, 1.0):
        together = gradients(targets_of([(CAR, 1.0)], [(other, weight)]), frames=2)[1]
        torch.testing.assert_close(together[0], alone[0])


def test_frames_of_a_batch_do_not_mix():
    """The loss of a batch is the sum of the losses of its frames."""
    frames = ([(CAR, 1.0)], [], [([5.0, -3.0, *CAR[2:]], 0.4), (CAR, 0.9)])
    given = random_outputs(3)
    together = weighted_loss(given, targets_of(*frames), PRESET, 2.0)["loss"]
    alone = [
        weighted_loss(
            NetworkOutput(*(part[i : i + 1] for part in given)), targets_of(frame), PRESET, 2.0
        )["loss"]
        for i, frame in enumerate(frames)
    ]
    torch.testing.assert_close(together, sum(alone))


def test_large_logits_stay_finite():
    """Saturated outputs give finite losses and gradients."""
    logits = torch.full((1, *PRESET.cells, 1), 60.0, requires_grad=True)
    wrong = heatmap_loss(logits, targets_of([(CAR, 1.0)])) + heatmap_loss(
        -logits, targets_of([(CAR, 1.0)])
    )
    wrong.backward()
    assert math.isfinite(float(wrong.detach()))
    assert torch.isfinite(logits.grad).all()
