"""Run the checks that need a GPU where there is one; elsewhere say that they were not run."""

import importlib.metadata
import os
import subprocess
import sys

import onnxruntime
import torch

NAMES = ("CUDA", "MIGraphX", "ROCM", "Dml", "CoreML")


def main() -> int:
    """Return the exit code of the tests; 0 if they cannot be run here."""
    found = [name for name in NAMES if f"{name}ExecutionProvider" in providers()]
    device = os.environ.get("CURATE_GPU_DEVICE", "")
    if not (torch.accelerator.is_available() or found or device):
        runtime = ", ".join(name.removesuffix("ExecutionProvider") for name in providers())
        print(
            f"make prove-gpu was NOT RUN: torch {torch.__version__} finds no accelerator, and ONNX "
            f"Runtime {importlib.metadata.version('onnxruntime')} has only {runtime}. Nothing was "
            "checked on a GPU."
        )
        return 0
    command = [sys.executable, "-m", "pytest", "-m", "gpu", "-rs", "-s", "-q", "tests/gpu"]
    return subprocess.run(command, check=False).returncode


def providers() -> list[str]:
    """Return the providers of ONNX Runtime."""
    return [name for name in onnxruntime.get_available_providers() if "Azure" not in name]


if __name__ == "__main__":
    sys.exit(main())
