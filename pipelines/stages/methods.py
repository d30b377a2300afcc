"""The methods that can be compared: each a policy and how its student learns, by one word.

The name of a method is the name of its policy, under which its weights and students are stored.
What a label of weight 0 is to the student, the policy says, see `Policy.zero_weight`.
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
"""What the labels of weight 0 are, in words."""


@dataclass(frozen=True)
class Method:
    """How labels are weighed, and who teaches the next round.

    Attributes:
        policy: of `POLICIES`, or package.module:Class.
        teacher: the "student" itself, or the moving average of its weights ("ema").
        note: what it is, in one line.
    """

    policy: str
    teacher: TeacherMode
    note: str


METHODS: Final[Mapping[str, Method]] = {
    method.policy: method
    for method in (
        Method("baseline", "student", "X_l alone, trained for as long as the others"),
        Method("uda", "student", "every label weighs 1 (UDA, Xie et al. 2020)"),
        Method("uda-cl", "student", "the easiest share e/E of the labels weighs 1 (UDA+CL)"),
        Method("sess", "ema", "every label weighs 1, averaged teacher (SESS, Zhao et al. 2020)"),
        Method(
            "3dioumatch", "ema",
            "score and IoU thresholds, averaged teacher (3DIoUMatch, Wang et al. 2021)",
        ),
        Method("spsl", "student", "SPSL-3D: v = 1 - L / lambda (An et al. 2023, Eq. 7)"),
        Method(
            "pspsl", "student", "PSPSL-3D: v = rho_det (1 - L / lambda) (An et al. 2023, Eq. 11)"
        ),
        Method("threshold", "student", "every label with a score from 0.3 on weighs 1"),
        Method("st3d", "student", "keep, ignore, drop with a memory (ST3D, Yang et al. 2021)"),
        Method("hssda", "ema", "two thresholds from the data (HSSDA, Liu et al. 2023)"),
    )
}  # fmt: skip


def method_named(name: str) -> Method:
    """The method of that name; any other policy is a method whose student teaches the next round.

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
        ConfigError: if there is no such method; the known ones are named.
    """
    method = method_named(name)
    return config.model_copy(
        update={"run": config.run.model_copy(update={"method": method.policy})}
    )


def method_of(config: Config, policy: str) -> Method:
    """Return the method of a policy, save where `train.teacher` is set."""
    method, teacher = method_named(policy), config.train.teacher
    return method if teacher == "method" else replace(method, teacher=teacher)


def zero_weight_of(config: Config, policy: str) -> ZeroWeight:
    """Return what a label of weight 0 is: the policy says, unless `train.zero_weight` is set."""
    chosen = config.train.zero_weight
    return open_policy(config, policy).zero_weight if chosen == "method" else chosen
