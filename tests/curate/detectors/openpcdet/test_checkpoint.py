"""Checkpoints: strict loading, both layouts of spconv, and what is rejected."""

import io
import json
import pickle
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from contracts.samples import assert_one_line
from support.openpcdet_files import document, random_network, save_state, write_files

from curate.detectors.openpcdet.checkpoint import load_network, save_checkpoint
from curate.errors import ConfigError, ModelError


def state_of(path: Path) -> dict[str, torch.Tensor]:
    """Return the weights of a checkpoint."""
    return torch.load(path, weights_only=True)["model_state"]


@pytest.mark.parametrize("name", ["PointPillar", "SECONDNet", "VoxelRCNN"])
def test_weights_load_as_they_are(tmp_path: Path, name: str) -> None:
    network, checkpoint = load_network(write_files(tmp_path, name))
    expected = random_network(name).state_dict()
    assert checkpoint.file is not None
    assert not network.training
    assert all(torch.equal(each, expected[key]) for key, each in network.state_dict().items())


def test_the_layout_of_spconv_1_and_a_parallel_prefix_load_as_well(tmp_path: Path) -> None:
    """Also where channels in and out are equal, so that the shape does not show the layout."""
    path = write_files(tmp_path)
    state = {
        f"module.{name}": each.permute(1, 2, 3, 4, 0).contiguous() if each.dim() == 5 else each
        for name, each in state_of(path).items()
        if not name.endswith("num_batches_tracked")
    }
    expected = load_network(path)[0].state_dict()
    save_state(path, state)
    found = load_network(path)[0].state_dict()
    assert all(torch.equal(each, expected[key]) for key, each in found.items())


def test_a_checkpoint_of_curate_has_its_model_file(tmp_path: Path) -> None:
    """It loads as it is, with equal bytes if it is written again."""
    network = random_network()
    paths = [tmp_path / name / "trained.pth" for name in ("a", "b")]
    for path in paths:
        save_checkpoint(path, network, network.state_dict(), "small")
    loaded, checkpoint = load_network(paths[0])
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert checkpoint.preset == "small"
    assert loaded.file == network.file
    assert all(map(torch.equal, loaded.state_dict().values(), network.state_dict().values()))


@pytest.mark.parametrize("old_format", [True, False])
@pytest.mark.parametrize("core", [b"numpy.core", b"numpy._core"])
def test_a_checkpoint_with_the_state_of_openpcdets_optimiser_loads(
    tmp_path: Path, old_format: bool, core: bytes
) -> None:
    """Its schedule computes with numpy; the numbers are pickled as those of numpy 1 or 2."""
    path = write_files(tmp_path)
    group = {"lr": np.float64(1e-3), "betas": (np.float32(0.9), 0.99), "step": np.int64(7)}
    content = {
        "model_state": state_of(path), "it": 5, "epoch": 80, "version": "pcdet+0.6.0",
        "optimizer_state": {"state": {0: {"step": 5}}, "param_groups": [group]},
    }  # fmt: skip
    expected = load_network(path)[0].state_dict()
    written = io.BytesIO()
    torch.save(content, written, _use_new_zipfile_serialization=not old_format)
    if old_format:  # in the other one, a changed byte would be damage
        written = io.BytesIO(re.sub(rb"numpy\._?core", core, written.getvalue()))
    path.write_bytes(written.getvalue())
    found = load_network(path)[0].state_dict()
    assert all(torch.equal(each, expected[key]) for key, each in found.items())


def drop_head(state: dict) -> None:
    del state["roi_head.cls_pred_layer.bias"]


def add_head(state: dict) -> None:
    state["point_head.weight"] = torch.zeros(1)


def widen(state: dict) -> None:
    state["backbone_2d.blocks.0.1.weight"] = torch.zeros(16, 16, 3, 3)


def fewer_classes(state: dict) -> None:
    for name in ("weight", "bias"):
        state[f"dense_head.conv_cls.{name}"] = state[f"dense_head.conv_cls.{name}"][:2]


def other_numbers(state: dict) -> None:
    name = "backbone_3d.conv_input.0.weight"
    state[name] = state[name].to(torch.complex64)


def not_finite(state: dict) -> None:
    state["dense_head.conv_box.bias"][0] = float("nan")


@pytest.mark.parametrize(
    ("harm", "message"),
    [
        (drop_head, "it has no roi_head.cls_pred_layer.bias"),
        (add_head, "it has also point_head.weight"),
        (widen, "backbone_2d.blocks.0.1.weight 16x16x3x3 instead of 8x16x3x3"),
        (fewer_classes, "the first numbers of dense_head follow from CLASS_NAMES and the anchors"),
        (other_numbers, "conv_input.0.weight 4x3x3x3x4 complex64 instead of 4x3x3x3x4"),
        (lambda state: state.update({5: torch.zeros(1)}), "it has also 5"),
        (not_finite, "NaN or infinite weights in dense_head.conv_box.bias"),
        (lambda state: state.update(name="text"), "name in model_state are not tensors"),
    ],
)
def test_what_does_not_fit_is_named(
    tmp_path: Path, harm: Callable[[dict], None], message: str
) -> None:
    path = write_files(tmp_path)
    state = state_of(path)
    harm(state)
    save_state(path, state)
    with pytest.raises(ModelError) as caught:
        load_network(path)
    assert_one_line(caught.value)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)


def test_another_architecture_is_named_by_what_is_missing(tmp_path: Path) -> None:
    path = write_files(tmp_path, "PointPillar")
    config = tmp_path / "other.yaml"
    config.write_text(json.dumps(document("SECONDNet")))
    with pytest.raises(
        ModelError, match=r"not a checkpoint of .*other\.yaml: it has no backbone_3d"
    ):
        load_network(path, config)


def test_a_checkpoint_without_model_file_says_how_to_give_it(tmp_path: Path) -> None:
    path = write_files(tmp_path)
    path.with_suffix(".yaml").unlink()
    with pytest.raises(ConfigError, match=r"give --detector-config FILE\.yaml") as caught:
        load_network(path)
    assert_one_line(caught.value)


class _Code:
    def __reduce__(self) -> tuple:
        return (Path("executed").touch, ())


@pytest.mark.parametrize("old_format", [True, False])
def test_code_in_a_checkpoint_is_not_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old_format: bool
) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_files(tmp_path)
    if old_format:
        path.write_bytes(pickle.dumps({"model_state": _Code()}))
    else:
        torch.save({"model_state": {}, "hook": _Code()}, path)
    with pytest.raises(ModelError) as caught:
        load_network(path)
    assert_one_line(caught.value)
    assert "model.pth" in str(caught.value)
    assert not Path("executed").exists()


def test_a_damaged_checkpoint_is_rejected_wherever_it_was_cut(tmp_path: Path) -> None:
    path = write_files(tmp_path)
    whole = path.read_bytes()
    for share in (0.0, 0.01, 0.5, 0.99):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ModelError, match=r"model\.pth: not a readable checkpoint") as caught:
            load_network(path)
        assert_one_line(caught.value)


def test_a_changed_byte_of_a_weight_is_damage(tmp_path: Path) -> None:
    """The checksums of the archive show it; torch does not compare them."""
    path = write_files(tmp_path)
    content = bytearray(path.read_bytes())
    weight = state_of(path)["backbone_2d.blocks.0.1.weight"].numpy().tobytes()
    content[content.index(weight) + 40] ^= 1
    path.write_bytes(content)
    with pytest.raises(ModelError, match=r"not a readable checkpoint: damaged"):
        load_network(path)


def test_a_compressed_archive_is_not_unpacked(tmp_path: Path) -> None:
    """Few bytes could become gigabytes."""
    path = write_files(tmp_path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(10**6))
    with pytest.raises(ModelError, match=r"not a readable checkpoint: damaged"):
        load_network(path)


def test_a_model_file_in_place_of_the_checkpoint_is_recognised(tmp_path: Path) -> None:
    config = write_files(tmp_path).with_suffix(".yaml")
    with pytest.raises(ModelError, match=r"model\.yaml: this is a model file, not a checkpoint"):
        load_network(config)
