"""The moving average of a student, by hand."""

import numpy as np
import pytest
import torch

from curate.detectors.pillars.network import PillarNetwork
from curate.detectors.pillars.presets import PRESETS
from curate.training.moving_average import MovingAverage, step_decay


def filled(value):
    """Return a network with one number for all weights and statistics."""
    network = PillarNetwork(PRESETS["small"], 1)
    with torch.no_grad():
        for tensor in network.state_dict().values():
            tensor.fill_(value)
    return network


def values(network):
    """Return the distinct numbers in the network's floats, and in its counters."""
    state = network.state_dict().values()
    floats = [tensor.flatten() for tensor in state if tensor.is_floating_point()]
    counters = [tensor.flatten() for tensor in state if not tensor.is_floating_point()]
    return np.unique(torch.cat(floats).numpy()), torch.cat(counters).unique().tolist()


def test_it_starts_at_the_student_and_follows_it():
    """With half kept per step: from 8 to 4, then to (4 + 2) / 2; counters are the student's."""
    average = MovingAverage(filled(8.0), 0.5 ** (1 / 5000), steps=2)
    assert values(average.network)[0].tolist() == [8.0]
    average.update(filled(0.0))
    average.update(filled(2.0))
    floats, counters = values(average.network)
    assert floats == pytest.approx([3.0], rel=1e-5)
    assert counters == [2]


def test_a_decay_of_0_is_the_student():
    average = MovingAverage(filled(8.0), 0.0, steps=100)
    average.update(filled(1.0))
    assert values(average.network)[0].tolist() == [1.0]


def test_the_student_is_not_modified():
    """The average is a copy without gradients."""
    student = filled(8.0)
    average = MovingAverage(student, 0.5, steps=10_000)
    average.update(filled(0.0))
    assert values(student)[0].tolist() == [8.0]
    assert not any(weight.requires_grad for weight in average.network.parameters())


@pytest.mark.parametrize("steps", [10, 1200, 10_000, 200_000])
def test_the_average_covers_the_same_share_of_any_training(steps):
    """After a tenth of the steps 0.999 ** 1000 of the earlier value is left: 37 %."""
    assert step_decay(0.999, steps) ** (steps / 10) == pytest.approx(0.999**1000)
    assert step_decay(0.999, 10_000) == pytest.approx(0.999)
