"""The declared layout of point files: which columns are read."""

import pytest

from curate.datasets.formats.point_layout import PointLayout
from curate.errors import ConfigError, DataError


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"columns": 2}, "columns = 2: must be 3 to 64"),
        ({"intensity_scale": 0.0}, "intensity_scale = 0.0: must be above 0"),
        ({"columns": 4, "column_names": ("x", "y", "z")}, "has 3 names, but columns is 4"),
        ({"column_names": ("x", "y", "z", "z")}, "contains 'z' twice"),
        ({"column_names": ("x", "y", "height")}, "no column z among x, y, height"),
        ({"column_names": ("x", "X", "y", "z")}, "several columns x"),
        (
            {"column_names": ("x", "y", "z", "intensity", "reflectivity")},
            "intensity and reflectivity may all be the intensity; set dataset.intensity_field",
        ),
        (
            {"column_names": ("x", "y", "z", "ring"), "intensity_field": "rings"},
            r"no column 'rings' .* among x, y, z, ring; did you mean 'ring'",
        ),
    ],
)
def test_an_invalid_layout_is_rejected(values: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PointLayout(**values)


@pytest.mark.parametrize(
    "name",
    [
        "intensity", "Intensity", "INTENSITY", "intensities", "reflectivity", "Reflectance", "i",
        "remission", "scalar_Intensity", "scalar_intensity",
    ],
)  # fmt: skip
def test_usual_names_of_the_intensity_are_recognised(name: str) -> None:
    layout = PointLayout()
    assert layout.indices("a.pcd", ["ring", name, "z", "y", "X"]) == [4, 3, 2, 1]


def test_other_columns_are_not_the_intensity() -> None:
    names = ["x", "y", "z", "rcs", "ring", "time", "rgb", ""]
    assert PointLayout().indices("a.pcd", names) == [0, 1, 2]


def test_one_of_two_candidates_is_chosen_by_name() -> None:
    """The exact name comes before one in another spelling."""
    names = ["x", "y", "z", "intensity", "Reflectivity"]
    with pytest.raises(DataError, match=r"a\.pcd: intensity and Reflectivity may all be"):
        PointLayout().indices("a.pcd", names)
    assert PointLayout(intensity_field="reflectivity").indices("a.pcd", names)[3] == 4
    assert PointLayout(intensity_field="intensity").indices("a.pcd", names)[3] == 3
    assert PointLayout(intensity_field="ring").indices("a.pcd", [*names, "ring"])[3] == 5
