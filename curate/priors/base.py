"""What every prior offers: a second opinion on each label, from data the detector did not judge."""

from dataclasses import fields
from typing import Any, ClassVar, Protocol

import numpy as np

from curate.detections import Detections
from curate.frames import Frame


class PriorEvidence(Protocol):
    """What a prior saw of n labels: a frozen dataclass whose fields are (n,) arrays.

    The field names are the columns in which the evidence is stored. They include the column that
    the prior names in `rho_column`, which also answers as `rho`.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def rho(self) -> np.ndarray:
        """(n,) float64 trust in each label, in [0, 1]."""
        ...


class Prior(Protocol):
    """Trusts or mistrusts each label of a frame; rho_det is the product over the priors."""

    name: ClassVar[str]
    rho_column: ClassVar[str]

    @property
    def needs_image(self) -> bool:
        """Whether `score` reads `frame.image`."""
        ...

    def score(self, frame: Frame, detections: Detections) -> PriorEvidence:
        """The evidence for each of the frame's detections, in their order."""
        ...


def columns(evidence: PriorEvidence) -> dict[str, np.ndarray]:
    """The evidence by column name."""
    return {field.name: getattr(evidence, field.name) for field in fields(evidence)}
