"""The mean teacher: a moving average of the student (Tarvainen and Valpola, NeurIPS 2017).

It starts with the student's weights. After the round, the average replaces the student: it is the
next teacher and is evaluated. SESS and 3DIoUMatch use a mean teacher.
"""

import copy

import torch

# The decay is defined per this share of a training. A decay then averages over the same share of
# any training, however many steps it has: 0.999 averages over about the last tenth.
_SHARE = 1 / 10_000


class MovingAverage:
    """Moving average of a network's parameters and of the statistics of its normalisations.

    Args:
        network: the student before its first step.
        decay: share of the average that is kept per ten-thousandth of the training, in [0, 1).
        steps: number of steps of the training.

    Attributes:
        network: the averaged network.
    """

    def __init__(self, network: torch.nn.Module, decay: float, steps: int) -> None:
        self.network = copy.deepcopy(network).requires_grad_(requires_grad=False)
        self._step_decay = step_decay(decay, steps)

    def update(self, student: torch.nn.Module) -> None:
        """Update the average with the student's current weights; counters are copied."""
        with torch.no_grad():
            average = self.network.state_dict()
            for name, current in student.state_dict().items():
                if current.is_floating_point():
                    average[name].lerp_(current, 1 - self._step_decay)
                else:
                    average[name].copy_(current)


def step_decay(decay: float, steps: int) -> float:
    """Return the share of the average that is kept per step.

    Args:
        decay: share that is kept per ten-thousandth of the training, in [0, 1).
        steps: number of steps of the training.
    """
    return float(decay ** (1 / (_SHARE * steps)))
