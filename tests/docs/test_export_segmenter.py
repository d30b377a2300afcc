"""examples/export_segmenter.py: a model that it writes is one that curate reads."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from support.paths import ROOT
from support.toys import toy_calibration
from torch import nn

from curate.frames import Frame
from curate.segmenters.onnx import OnnxSegmenter


class Reddish(nn.Module):
    """A model in torchvision's form: class 7 where an image is red, scores of half the size."""

    def forward(self, image: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return scores of 21 classes."""
        red = nn.functional.avg_pool2d(image[:, :1], 2)
        return {
            "out": torch.cat(
                [torch.zeros_like(red).expand(-1, 7, -1, -1), red] + 13 * [-red.abs()], dim=1
            )
        }


@pytest.fixture(scope="module")
def script() -> ModuleType:
    """The script, as a module."""
    spec = importlib.util.spec_from_file_location(
        "export_segmenter", ROOT / "examples" / "export_segmenter.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.filterwarnings("ignore")  # torch's exporter warns of its own code
def test_an_exported_model_gives_the_classes_of_an_image(
    script: ModuleType, tmp_path: Path
) -> None:
    """The right half of an image is red, and of class 7."""
    pytest.importorskip("onnxscript", reason="torch exports ONNX with onnxscript")
    path = tmp_path / "model.onnx"
    script.export_semantic(Reddish(), path, height=64, width=128)
    image = np.zeros((64, 128, 3), dtype=np.uint8)
    image[:, 64:, 0] = 255
    points = np.zeros((0, 4), dtype=np.float32)
    frame = Frame("x", points, toy_calibration(), (128, 64), image)
    found = OnnxSegmenter(path, {"Car": (7,)}).segment(frame)
    assert (found.class_ids[:, 66:] == 7).all()
    assert (found.class_ids[:, :62] == 0).all()


def test_the_options_for_init_are_printed(
    script: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Each kind of model has its segmenter and its set of classes."""
    monkeypatch.setattr(script, "deeplab", lambda weights: Reddish())
    monkeypatch.setattr(script, "export_semantic", lambda model, path, height, width: None)
    script.main(["deeplab", str(tmp_path / "model.onnx")])
    printed = capsys.readouterr().out
    assert f"--segmenter onnx --segmenter-path {tmp_path / 'model.onnx'}" in printed
    assert printed.endswith("--segmenter-classes voc\n")
