"""The mean teacher: a moving average of the student (Tarvainen and Valpola, NeurIPS 2017).

It starts where the student starts. After the round it is what teaches and what is evaluated, in
place of the student; SESS and 3DIoUMatch use one.
"""

import copy

import torch

# A decay is stated for this share of a training, so that the average looks back over the same share
# of any training: 0.999 forgets over its last tenth.
_SHARE = 1 / 10_000


class MovingAverage:
    """Follows a network; averages parameters and the statistics of its normalisations alike.

    Args:
        network: the student before its first step.
        decay: how much of the average is kept per ten-thousandth of the training, in [0, 1).
        steps: of the training.

    Attributes:
        network: the average.
    """

    def __init__(self, network: torch.nn.Module, decay: float, steps: int) -> None:
        self.network = copy.deepcopy(network).requires_grad_(requires_grad=False)
        self._kept = step_decay(decay, steps)

    def follow(self, student: torch.nn.Module) -> None:
        """Take the student's weights in; counters are copied."""
        with torch.no_grad():
            own = self.network.state_dict()
            for name, present in student.state_dict().items():
                if present.is_floating_point():
                    own[name].lerp_(present, 1 - self._kept)
                else:
                    own[name].copy_(present)


def step_decay(decay: float, steps: int) -> float:
    """How much of the average is kept per step."""
    return float(decay ** (1 / (_SHARE * steps)))
