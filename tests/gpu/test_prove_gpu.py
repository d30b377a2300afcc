"""`make prove-gpu` on a machine without a GPU."""

import os
import subprocess
import sys

import pytest
import torch
from support.paths import ROOT
from support.utilisation import Utilisation

from curate.files.onnx_providers import installed_providers


def test_without_a_gpu_it_says_that_nothing_was_checked():
    """With exit code 0, and what was looked for."""
    if torch.accelerator.is_available() or installed_providers()[0].name != "cpu":
        pytest.skip("this machine has an accelerator")
    environment = {key: value for key, value in os.environ.items() if key != "CURATE_GPU_DEVICE"}
    done = subprocess.run(
        [sys.executable, ".ci/prove_gpu.py"], cwd=ROOT, env=environment,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(f"make prove-gpu was NOT RUN: torch {torch.__version__} finds no")
    assert "Nothing was checked on a GPU" in done.stdout


def test_the_utilisation_is_that_of_nvidias_tool(tmp_path, monkeypatch):
    """Lines without a number are left out; without the tool it is unknown."""
    monkeypatch.setenv("PATH", str(tmp_path))
    with Utilisation() as busy:
        pass
    assert str(busy) == "utilisation unknown (no nvidia-smi)"
    tool = tmp_path / "nvidia-smi"
    tool.write_text("#!/bin/sh\nprintf '40, 1000\\n60, 1500\\n[N/A], 7\\n'\n")
    tool.chmod(0o755)
    with Utilisation() as busy:
        busy._process.wait()  # noqa: SLF001 - the real one runs until it is ended
    assert str(busy) == "GPU 50 % busy, 1500 MiB used"
