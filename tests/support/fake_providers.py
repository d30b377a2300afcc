"""Execution providers that ONNX Runtime seems to have, on a machine without any of them."""

from dataclasses import dataclass, field
from typing import Any

import onnxruntime
import pytest

CPU = "CPUExecutionProvider"


@dataclass
class FakeRuntime:
    """What the fake ONNX Runtime has and does; each name without "ExecutionProvider".

    Attributes:
        installed: providers of the installed package, besides the CPU.
        silent: those that cannot be loaded, without an error: the real one continues on the CPU.
        raising: those with which creating a session raises an error.
        opened: the providers of each session that was created, with their options.
    """

    installed: tuple[str, ...] = ()
    silent: tuple[str, ...] = ()
    raising: tuple[str, ...] = ()
    opened: list[dict[str, dict[str, Any]]] = field(default_factory=list)


class FakeSession:
    """A session of the real ONNX Runtime on the CPU, which claims the fake providers."""

    def __init__(
        self, runtime: FakeRuntime, real: Any, path: str, options: Any, providers: list, **keywords
    ):
        asked = {name.removesuffix("ExecutionProvider"): own for name, own in providers}
        for name in runtime.raising:
            if name in asked:
                raise RuntimeError(f"first line\nCUDA failure 100: no device for {name}")
        self._session = real(path, options, providers=[CPU], **keywords)
        self._providers = [
            f"{name}ExecutionProvider" for name in asked if name not in runtime.silent
        ]
        runtime.opened.append(asked)

    def get_providers(self) -> list[str]:
        return [*self._providers, *([CPU] if CPU not in self._providers else [])]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)


def fake_providers(monkeypatch: pytest.MonkeyPatch, runtime: FakeRuntime) -> FakeRuntime:
    """Replace ONNX Runtime's list of providers and its sessions until the end of the test."""
    real = onnxruntime.InferenceSession
    names = [*(f"{name}ExecutionProvider" for name in runtime.installed), CPU]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: names)
    monkeypatch.setattr(
        onnxruntime,
        "InferenceSession",
        lambda *arguments, **keywords: FakeSession(runtime, real, *arguments, **keywords),
    )
    return runtime


class DetectorInTorch:
    """A detector of a user that runs in torch, on the device that it is given."""

    def __init__(self, path: Any, device: str) -> None:
        self.device = device

    def predict(self, frame: Any) -> None:
        raise NotImplementedError
