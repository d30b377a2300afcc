"""The methods that can be compared: each a policy and how its student learns, by one word.

The name of a method is the name of its policy, under which its weights and students are stored.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

from curate.errors import ConfigError
from pipelines.registry import POLICIES
from pipelines.workspace.config import Config

TeacherMode = Literal["student", "ema"]
ZeroWeight = Literal["ignore", "background"]


@dataclass(frozen=True)
class Method:
    """How labels are weighed, what a weight of 0 is, and who teaches the next round.

    Attributes:
        policy: of `POLICIES`, or package.module:Class.
        teacher: the "student" itself, or the moving average of its weights ("ema").
        note: what it is, in one line.
        zero_weight: what a label of weight 0 is to the student: "background", as nearly all of
            them are none (docs/results.md), or a region to "ignore" where the method has a band of
            doubt between what it keeps and what it drops.
    """

    policy: str
    teacher: TeacherMode
    note: str
    zero_weight: ZeroWeight = "background"


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
        Method(
            "st3d", "student", "keep, ignore, drop with a memory (ST3D, Yang et al. 2021)",
            "ignore",
        ),
        Method("hssda", "ema", "two thresholds from the data (HSSDA, Liu et al. 2023)", "ignore"),
    )
}  # fmt: skip


def method_named(name: str) -> Method:
    """The method of that name; any other policy is a method whose student teaches the next round.

    Raises:
        ConfigError: there is no such method or policy.
    """
    if name in METHODS:
        return METHODS[name]
    if name in POLICIES.classes or ":" in name:
        return Method(name, "student", "a policy")
    raise ConfigError(
        f"unknown method {name!r}: use one of {', '.join(METHODS)}, or a policy module:Class"
    )


def with_method(config: Config, name: str) -> Config:
    """The configuration with another method.

    Raises:
        ConfigError: there is no such method; the known ones are named.
    """
    method = method_named(name)
    return config.model_copy(
        update={"run": config.run.model_copy(update={"method": method.policy})}
    )


def method_of(config: Config, policy: str) -> Method:
    """The method of a policy, save where `train.teacher` or `train.zero_weight` is set."""
    method, section = method_named(policy), config.train
    if section.teacher != "method":
        method = replace(method, teacher=section.teacher)
    if section.zero_weight != "method":
        method = replace(method, zero_weight=section.zero_weight)
    return method
