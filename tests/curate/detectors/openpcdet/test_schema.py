"""Model files: what is read, and what is rejected by name."""

import json
from pathlib import Path

import pytest
from contracts.samples import assert_one_line
from support.openpcdet_files import document

from curate.detectors.openpcdet.schema import load_model_file, parse_model_file
from curate.errors import ConfigError

NAMES = ("PointPillar", "SECONDNet", "VoxelRCNN")


def change(content: dict, path: str, value: object) -> dict:
    """Return the content with another value at a path; None removes the key."""
    *sections, key = path.split("/")
    section = content
    for each in sections:
        section = section[int(each) if each.isdigit() else each]
    if value is None:
        del section[key]
    else:
        section[key] = value
    return content


@pytest.mark.parametrize("name", NAMES)
def test_a_model_file_survives_being_written(name: str) -> None:
    file = parse_model_file(document(name), "test.yaml")
    assert parse_model_file(json.loads(file.to_text()), "written") == file


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("MODEL/PFE", {}, "unknown key MODEL.PFE; did you mean 'VFE'?"),
        ("MODEL/NAME", "PVRCNN", "MODEL.NAME: 'PVRCNN' is not supported"),
        ("MODEL/VFE/NAME", "DynMeanVFE", "MODEL.VFE: 'DynMeanVFE' is not supported"),
        ("MODEL/VFE/WITH_TIME", True, "unknown key MODEL.VFE.WITH_TIME"),
        ("MODEL/DENSE_HEAD/DIR_OFSET", 1, "DIR_OFSET; did you mean 'DIR_OFFSET'?"),
        ("MODEL/DENSE_HEAD/NAME", "CenterHead", "MODEL.DENSE_HEAD.NAME: 'CenterHead' is not"),
        ("MODEL/ROI_HEAD", None, "ROI_HEAD: VoxelRCNN needs one"),
        ("MODEL/BACKBONE_2D/NUM_FILTERS", [8], "all lists need one number per level"),
        ("MODEL/MAP_TO_BEV/NUM_BEV_FEATURES", 128, "these modules give 16"),
        ("MODEL/POST_PROCESSING/NMS_CONFIG/MULTI_CLASSES_NMS", True, "True is not supported"),
        ("MODEL/POST_PROCESSING/SCORE_THRESH", None, "MODEL.POST_PROCESSING.SCORE_THRESH is miss"),
        ("CLASS_NAMES", ["Van"], "has anchors for Car, Pedestrian, Cyclist; CLASS_NAMES are Van"),
        (
            "DATA_CONFIG/POINT_FEATURE_ENCODING/used_feature_list",
            ["x", "y", "z", "intensity", "elongation"],
            "used_feature_list: x, y, z, intensity, elongation: curate gives a detector x, y, z, i",
        ),
        (
            "DATA_CONFIG/POINT_CLOUD_RANGE",
            [0, -25600, -3, 51200, 25600, 1],
            "256000 x 256000 voxels are too many; give metres",
        ),
        ("DATA_CONFIG/POINT_CLOUD_RANGE", [0, 0, 0, 0, 1, 1], "give x, y, z low, then x, y, z"),
        ("DATA_CONFIG/DATA_PROCESSOR/1/NAME", "sample_points", "'sample_points' is not supported"),
        (
            "MODEL/DENSE_HEAD/ANCHOR_GENERATOR_CONFIG/0/feature_map_stride",
            4,
            "the map of these modules has a stride of 8",
        ),
    ],
)
def test_what_is_not_supported_is_named(path: str, value: object, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_model_file(change(document(), path, value), "model.yaml")
    assert_one_line(caught.value)
    assert str(caught.value).startswith("model.yaml: ")
    assert message in str(caught.value)


def test_a_wrong_number_is_named_alone() -> None:
    """Without the lists that it is in."""
    path = "MODEL/DENSE_HEAD/ANCHOR_GENERATOR_CONFIG/0/anchor_sizes"
    with pytest.raises(ConfigError) as caught:
        parse_model_file(change(document(), path, [[3.9, 1.6]]), "model.yaml")
    place = "MODEL.DENSE_HEAD.ANCHOR_GENERATOR_CONFIG.0.anchor_sizes.0.2"
    assert str(caught.value) == f"model.yaml: {place} is missing"


def test_keys_of_training_and_data_preparation_are_accepted() -> None:
    content = change(document(), "OPTIMIZATION", {"LR": 0.01})
    content = change(content, "DATA_CONFIG/DATA_AUGMENTOR", {"AUG_CONFIG_LIST": []})
    assert parse_model_file(content, "test.yaml") == parse_model_file(document(), "test.yaml")


def test_the_base_file_is_found_in_a_folder_above(tmp_path: Path) -> None:
    """As in OpenPCDet's tools/cfgs; the model file's own values come first."""
    content = document()
    base, own = dict(content["DATA_CONFIG"]), {"_BASE_CONFIG_": "cfgs/dataset_configs/base.yaml"}
    own["POINT_CLOUD_RANGE"] = base["POINT_CLOUD_RANGE"]
    base["POINT_CLOUD_RANGE"] = [0, 0, 0, 1, 1, 1]
    base["DATASET"] = "KittiDataset"
    path = tmp_path / "tools/cfgs/kitti_models/model.yaml"
    for file, text in ((path, {**content, "DATA_CONFIG": own}),
                       (tmp_path / "tools" / own["_BASE_CONFIG_"], base)):  # fmt: skip
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps(text))
    assert load_model_file(path) == parse_model_file(content, "test.yaml")


def test_the_base_file_of_kitti_may_be_missing(tmp_path: Path) -> None:
    content = document("SECONDNet")
    content["DATA_CONFIG"] = {"_BASE_CONFIG_": "cfgs/dataset_configs/kitti_dataset.yaml"}
    path = tmp_path / "second.yaml"
    path.write_text(json.dumps(content))
    assert load_model_file(path).data_config.grid == (1408, 1600, 40)
    content["DATA_CONFIG"]["_BASE_CONFIG_"] = "cfgs/dataset_configs/other.yaml"
    path.write_text(json.dumps(content))
    with pytest.raises(ConfigError, match=r"other\.yaml was not found; put other\.yaml beside it"):
        load_model_file(path)


@pytest.mark.parametrize("text", ["a: [", "- 1", "", "\x00", "!!python/object/apply:os.getcwd []"])
def test_a_file_that_is_not_a_model_file_is_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"broken\.yaml: not a ") as caught:
        load_model_file(path)
    assert_one_line(caught.value)
