"""The methods that the paper compares, each a policy, by the one word that a user types."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from curate.errors import ConfigError
from pipelines.config import Config


@dataclass(frozen=True)
class Method:
    """What a method is made of.

    Attributes:
        policy: that weighs the labels.
        note: in a few words.
    """

    policy: str
    note: str


METHODS: Mapping[str, Method] = MappingProxyType({
    "baseline": Method("baseline", "X_l alone, trained as long"),
    "uda": Method("uniform", "every label weighs 1"),
    "spsl": Method("spsl", "self-paced, Eq. 7"),
    "pspsl": Method("pspsl", "self-paced with priors, Eq. 11"),
    "threshold": Method("threshold", "labels above a score"),
})  # fmt: skip


def with_method(config: Config, name: str) -> Config:
    """The configuration under a method.

    Raises:
        ConfigError: nobody knows the method.
    """
    if name not in METHODS:
        raise ConfigError(f"unknown method '{name}': use one of {', '.join(METHODS)}")
    solve = config.solve.model_copy(update={"policy": METHODS[name].policy})
    return config.model_copy(update={"solve": solve})
