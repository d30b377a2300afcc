"""The example of the page about evidence sources."""

import re
from typing import Any

import numpy as np
from support.paths import ROOT
from support.toys import IMAGE_SIZE, toy_calibration

from curate.detections import Detections, as_categories
from curate.exporters.columns import WEIGHTED_LABELS
from curate.frames import Frame
from curate.priors.base import check_declaration, check_evidence


def test_the_example_is_a_source() -> None:
    """It declares valid columns and returns them."""
    page = (ROOT / "docs" / "evidence.md").read_text()
    [code] = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)  # noqa: S102 - our own page
    source = names["HeightPrior"]()
    check_declaration(source, {column.name for column in WEIGHTED_LABELS})
    boxes = np.array([[10.0, 0, 0, 4, 2, 2, 0], [20.0, 0, 0, 4, 2, 2, 0]])
    points = np.array([[10.0, 0, 0.5, 0], [10, 0.2, 0.7, 0], [10, 0, -0.5, 0]], dtype=np.float32)
    labels = Detections(boxes, np.ones(2), as_categories(["Car", "Car"]))
    frame = Frame("x", points, toy_calibration(), IMAGE_SIZE)
    found = check_evidence(source, source.score(frame, labels), 2)
    assert found == {"top_points": [2, 0], "rho_height": [2 / 3, 0.0]}
