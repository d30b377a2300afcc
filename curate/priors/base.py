"""What every prior offers: a second opinion on each label, from data the detector did not judge."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar, Protocol

import numpy as np

from curate.detections import Detections
from curate.frames import Frame

Measured = Mapping[str, np.ndarray]
"""(n,) arrays of n labels, by the names of `Prior.measured_columns`."""


class PriorEvidence(Protocol):
    """What a prior saw of n labels: a frozen dataclass whose fields are (n,) arrays.

    The field names are the columns in which the evidence is stored. They include the columns that
    the prior has measured and the one that it names in `rho_column`, which also answers as `rho`.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def rho(self) -> np.ndarray:
        """(n,) float64 trust in each label, in [0, 1]."""
        ...


class Prior(Protocol):
    """Trusts or mistrusts each label of a frame; rho_det is the product over the priors.

    A prior that never looks at `frame.points` may have a further attribute, `needs_points`, that is
    false; the points are then not read for it.

    It answers in two steps: measuring looks at what the sensors saw, which may be slow, rating is
    arithmetic on what was measured. Who changes the formula need not measure again.

    The pipeline gives the constructor what it names: `segmenter` (None where nothing is to be
    measured), `thresholds` (points per category, learned from X_l), and the user's options.
    """

    name: ClassVar[str]
    rho_column: ClassVar[str]
    measured_columns: ClassVar[tuple[str, ...]]

    @property
    def needs_image(self) -> bool:
        """Whether `measure` reads `frame.image`."""
        ...

    def measure(self, frame: Frame, detections: Detections) -> Measured:
        """What the frame shows of each of its detections, in their order."""
        ...

    def rate(self, detections: Detections, measured: Measured) -> PriorEvidence:
        """The evidence that follows from what was measured."""
        ...

    def score(self, frame: Frame, detections: Detections) -> PriorEvidence:
        """Both steps: the evidence for each of the frame's detections, in their order."""
        ...


def columns(evidence: PriorEvidence) -> dict[str, np.ndarray]:
    """The evidence by column name."""
    return {field.name: getattr(evidence, field.name) for field in fields(evidence)}
