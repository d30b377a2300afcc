"""The tables of semantic classes."""

import re

import pytest
from support.paths import ROOT

from curate.detections import CATEGORIES
from curate.errors import ConfigError
from curate.segmenters.classes import CLASS_MAPS, checked_classes, class_map
from curate.simulation.scene import SEMANTIC_CLASSES


@pytest.mark.parametrize("name", sorted(CLASS_MAPS))
def test_every_table_has_classes_for_every_category(name):
    """No category of the project is without pixels."""
    assert set(class_map(name)) == set(CATEGORIES)
    assert checked_classes(class_map(name)) == class_map(name)


def test_the_simulated_classes_are_those_of_the_simulator():
    """The table and the simulator's semantic maps use the same ids."""
    assert class_map("simulated") == {name: (one,) for name, one in SEMANTIC_CLASSES.items()}


def test_riders_are_not_pedestrians_if_the_classes_differ():
    """Cityscapes has riders; VOC and COCO only persons, who count for both."""
    for name in ("cityscapes", "cityscapes-label-ids"):
        riders = class_map(name)
        assert not set(riders["Cyclist"]) & set(riders["Pedestrian"])
    for name in ("voc", "coco"):
        assert set(class_map(name)["Pedestrian"]) < set(class_map(name)["Cyclist"])


def test_the_error_for_an_unknown_table_lists_the_known_ones():
    with pytest.raises(
        ConfigError, match="unknown class set 'ade': use one of camvid, cityscapes, city"
    ):
        class_map("ade")


@pytest.mark.parametrize("one", [-1, 256, 1.5, "7"])
def test_ids_beyond_8_bits_are_rejected(one):
    """A semantic map has 8 bits per pixel."""
    with pytest.raises(ConfigError, match="of Car: an id is an integer from 0 to 255"):
        checked_classes({"Car": [one]})


def test_the_page_shows_the_tables():
    """docs/segmenters.md lists the built-in numbers."""
    page = (ROOT / "docs" / "segmenters.md").read_text()
    numbers = r" \| ([\d, ]+)" * 3
    rows = re.findall(rf"^\| `([\w-]+)`.*?{numbers} \|$", page, re.MULTILINE)
    shown = {
        name: {
            category: tuple(map(int, ids.split(",")))
            for category, ids in zip(CATEGORIES, columns, strict=True)
        }
        for name, *columns in rows
    }
    assert shown == {name: CLASS_MAPS[name] for name in CLASS_MAPS if name != "simulated"}
