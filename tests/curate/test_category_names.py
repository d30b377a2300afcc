"""Category names of two sides: renamed, and compared."""

import numpy as np
import pytest

from curate.category_names import NamedSide, check_rename, compare_names, listed, renamed
from curate.detections import Detections, as_categories
from curate.errors import ConfigError

CATEGORIES = ("Car", "Pedestrian", "Cyclist")


def compare(*names, rename=None, accepted=(), counts=None):
    """Return (wrong, message) of each finding."""
    side = NamedSide("the label files", counts or names, "dataset.rename", rename or {}, accepted)
    return [(each.wrong, each.message) for each in compare_names(side, CATEGORIES)]


def test_equal_names_have_no_findings():
    """DontCare is not a category; a side without names has nothing to compare."""
    assert compare(*CATEGORIES, "DontCare") == []
    assert compare() == compare("DontCare") == []


def test_nothing_in_common_is_wrong():
    """Both sides are listed with counts, and the mapping that would make them agree."""
    [(wrong, message)] = compare(counts={"car": 6, "cyclist": 3})
    assert wrong
    assert "the label files have car 6, cyclist 3, but dataset.categories are Car, Ped" in message
    assert """--set 'dataset.rename={car="Car", cyclist="Cyclist"}'""" in message
    assert """rename = {car="Car", cyclist="Cyclist"} in [dataset] of curate.toml""" in message


def test_names_without_a_similar_category_get_an_example():
    """Of the same form."""
    [(wrong, message)] = compare("vehicle")
    assert wrong
    assert """rename = {vehicle="Car"} in [dataset] of curate.toml, for example""" in message


@pytest.mark.parametrize("name", ["car", "CAR", "cyclist"])
def test_other_letters_are_wrong(name):
    """Even if other names agree."""
    found = compare("Pedestrian", name)
    assert [message for wrong, message in found if wrong and "in another spelling" in message]


def test_an_unlisted_name_and_a_missing_one_are_warnings():
    """Both are said, with what would use the name."""
    found = compare("Car", "Pedestrian", "Bicyclist")
    assert not any(wrong for wrong, _ in found)
    unlisted, missing = (message for _, message in found)
    assert "have Bicyclist, which dataset.categories does not list: left out" in unlisted
    assert """{Bicyclist="Cyclist"}""" in unlisted
    assert "have no Cyclist, only Bicyclist, Car, Pedestrian" in missing


def test_accepted_names_are_not_reported():
    """Those of the benchmark, and those that are mapped to themselves."""
    assert compare(*CATEGORIES, "Van", accepted={"Van"}) == []
    assert compare(*CATEGORIES, "Bus", rename={"Bus": "Bus"}) == []
    assert compare(*CATEGORIES, "car", rename={"car": "car"}) == []


def test_a_mapping_is_applied_before_the_comparison():
    """Names that are renamed already, as in a database, are the same."""
    rename = {"car": "Car", "Person": "Pedestrian"}
    assert compare("car", "Person", "Cyclist", rename=rename) == []
    stored = NamedSide("the label files", CATEGORIES, "dataset.rename", rename, original=False)
    assert compare_names(stored, CATEGORIES) == []


def test_a_mapping_that_does_nothing_is_reported():
    """A source that never occurs, and a target that is not a category."""
    [(wrong, message)] = compare(*CATEGORIES, "Bus", rename={"Buss": "Car", "Bus": "Bus"})
    assert not wrong
    assert message == "dataset.rename: the label files have no 'Buss'; did you mean 'Bus'?"
    found = compare(*CATEGORIES, "Bus", rename={"Bus": "Carr"})
    assert "'Carr' is not in dataset.categories; did you mean 'Car'?" in found[0][1]


def test_a_suggested_mapping_contains_the_present_one():
    """It can be pasted as it is."""
    found = compare("auto", "cyclist", rename={"auto": "Car"})
    assert """{auto="Car", cyclist="Cyclist"}""" in found[0][1]


@pytest.mark.parametrize(
    ("rename", "message"),
    [
        ({"a": "b", "b": "c"}, "'a' becomes 'b', which becomes 'c'; write the final name of each"),
        ({"a": "b", "b": "a"}, "'a' becomes 'b', which becomes 'a'"),
        ({"DontCare": "Car"}, "DontCare cannot be renamed"),
    ],
)
def test_a_mapping_must_be_final(rename, message):
    """Renaming twice must be the same as renaming once."""
    with pytest.raises(ConfigError, match=message):
        check_rename(rename)


def test_detections_are_renamed():
    """Other names stay; longer names are not cut."""
    found = Detections(np.ones((2, 7)), np.ones(2), as_categories(["car", "Van"]))
    assert renamed(found, {"car": "Passenger_car"}).categories.tolist() == ["Passenger_car", "Van"]
    assert renamed(found, None) is found


def test_long_lists_are_shortened():
    """Only the first names are shown."""
    names = {f"name{i}": i for i in range(9)}
    assert listed(names).endswith("name5 5 and 3 more")
    assert listed(["x" * 99]) == "x" * 40
