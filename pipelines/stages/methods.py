"""The methods that can be compared. A method is a policy and a way to get the next teacher.

The name of a method is the name of its policy; its weights and students are stored under it. The
policy defines what a label of weight 0 means in training, see `Policy.zero_weight`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

from curate.errors import ConfigError
from curate.spelling import did_you_mean
from curate.weighting.base import ZeroWeight
from pipelines.assembly import open_policy
from pipelines.registry import POLICIES
from pipelines.workspace.config import Config

TeacherMode = Literal["student", "ema"]

ZERO_WEIGHT_WORDS: Final[Mapping[ZeroWeight, str]] = {
    "background": "background",
    "ignore": "regions to ignore",
}
"""The treatment of labels with weight 0, as text for reports."""


@dataclass(frozen=True)
class Method:
    """A policy, and the choice of the next round's teacher.

    Attributes:
        policy: name of the policy: registered in `POLICIES`, or `package.module:Class`.
        teacher: "student" for the student itself, "ema" for the moving average of its weights.
        note: description in one line.
    """

    policy: str
    teacher: TeacherMode
    note: str


METHODS: Final[Mapping[str, Method]] = {
    method.policy: method
    for method in (
        Method("baseline", "student", "X_l alone, trained for as long as the others"),
        Method("uda", "student", "weight 1 for every label (UDA, Xie et al. 2020)"),
        Method("uda-cl", "student", "weight 1 for the easiest share e/E of the labels (UDA+CL)"),
        Method(
            "sess", "ema", "weight 1 for every label, averaged teacher (SESS, Zhao et al. 2020)"
        ),
        Method(
            "3dioumatch", "ema",
            "score and IoU thresholds, averaged teacher (3DIoUMatch, Wang et al. 2021)",
        ),
        Method("spsl", "student", "SPSL-3D: v = 1 - L / lambda (An et al. 2023, Eq. 7)"),
        Method(
            "pspsl", "student", "PSPSL-3D: v = rho_det (1 - L / lambda) (An et al. 2023, Eq. 11)"
        ),
        Method("learned", "student", "v = p^gamma, p = probability that the label is correct"),
        Method("threshold", "student", "weight 1 for every label with a score of at least 0.3"),
        Method("st3d", "student", "keep, ignore, drop with a memory (ST3D, Yang et al. 2021)"),
        Method("hssda", "ema", "two thresholds from the data (HSSDA, Liu et al. 2023)"),
    )
}  # fmt: skip


def method_named(name: str) -> Method:
    """Return the method with this name.

    A policy that is not in METHODS is a method too; its teacher is the student itself.

    Raises:
        ConfigError: if there is no such method or policy.
    """
    if name in METHODS:
        return METHODS[name]
    if name in POLICIES.classes or ":" in name:
        return Method(name, "student", "a policy")
    raise ConfigError(
        f"unknown method {name!r}: use one of {', '.join(METHODS)}, or a policy module:Class"
        f"{did_you_mean(name, METHODS)}"
    )


def with_method(config: Config, name: str) -> Config:
    """Return the configuration with another method.

    Raises:
        ConfigError: if there is no such method; the message lists the available ones.
    """
    method = method_named(name)
    return config.model_copy(
        update={"run": config.run.model_copy(update={"method": method.policy})}
    )


def method_of(config: Config, policy: str) -> Method:
    """Return the method of a policy; the setting `train.teacher` overrides its teacher."""
    method, teacher = method_named(policy), config.train.teacher
    return method if teacher == "method" else replace(method, teacher=teacher)


def zero_weight_of(config: Config, policy: str) -> ZeroWeight:
    """Return the meaning of weight 0: that of `train.zero_weight` if set, else the policy's."""
    setting = config.train.zero_weight
    return open_policy(config, policy).zero_weight if setting == "method" else setting
