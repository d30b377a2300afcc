"""Execution providers of ONNX Runtime: which one is taken, and what happens if one does not work.

No provider but the CPU's is installed here. `FakeRuntime` behaves like ONNX Runtime 1.31 with
onnxruntime-gpu on a machine without CUDA: a provider that cannot be loaded is left out silently, or
raises an error.
"""

import logging
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from onnx import TensorProto
from support.fake_providers import FakeRuntime, fake_providers
from support.tiny_onnx import constant_model, tiny_detector

from curate.errors import ConfigError, ModelError
from curate.files.onnx_providers import (
    PROVIDERS,
    installed_providers,
    is_exclusive,
    open_session,
    provider_named,
    providers_of_device,
    requested_providers,
    runtime_errors,
)
from curate.files.onnx_session import OnnxModel
from curate.warnings_once import NOTES, note_once, warn_once


@pytest.fixture(autouse=True)
def _nothing_said(caplog):
    """Forget what was said in earlier tests."""
    warn_once.cache_clear()
    note_once.cache_clear()
    caplog.set_level(logging.INFO, logger=NOTES)


@pytest.fixture
def path(tmp_path):
    """Return a model with a free number of points."""
    tiny_detector(tmp_path / "model.onnx")
    return tmp_path / "model.onnx"


@pytest.fixture
def having(monkeypatch):
    """Return a function that pretends that providers are installed."""
    return lambda *installed, **faults: fake_providers(
        monkeypatch, FakeRuntime(installed, **faults)
    )


def names(providers):
    """Return the names of providers."""
    return [each.name for each in providers]


def test_the_cpu_is_always_there_and_needs_no_word(path, caplog):
    """The package that is installed here has nothing else; its Azure provider runs no model."""
    assert names(installed_providers()) == ["cpu"]
    session = open_session(path, providers="auto")
    assert session.get_providers() == ["CPUExecutionProvider"]
    assert not caplog.records


def test_auto_takes_the_best_provider_and_says_it_once(path, having, caplog):
    """CUDA before OpenVINO; TensorRT is never taken, because it builds engines for minutes."""
    runtime = having("Tensorrt", "OpenVINO", "CUDA")
    for _ in range(2):
        assert open_session(path, providers="auto").get_providers()[0] == "CUDAExecutionProvider"
    assert runtime.opened == [{"CUDA": {"use_tf32": 0}}] * 2
    assert caplog.messages == ["model.onnx runs on ONNX Runtime's provider 'cuda'"]


def test_auto_falls_back_from_provider_to_provider_with_one_line_each(path, having, caplog):
    """CUDA raises, OpenVINO is left out silently by ONNX Runtime; the CPU remains."""
    having("CUDA", "OpenVINO", raising=("CUDA",), silent=("OpenVINO",))
    for _ in range(2):
        assert open_session(path, providers="auto").get_providers() == ["CPUExecutionProvider"]
    cuda, openvino = caplog.messages
    assert cuda == (
        f"{path}: provider 'cuda' cannot be used: first line CUDA failure 100: no device for CUDA. "
        "The model runs without it"
    )
    assert "provider 'openvino' cannot be used: it found no device that it can use" in openvino
    assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING"]


def test_workers_do_not_repeat_what_their_parent_has_said(path, having, caplog, monkeypatch):
    """A worker process is quiet; its parent has opened the same model before."""
    having("CUDA", silent=("CUDA",))
    monkeypatch.setattr("curate.files.onnx_providers.parent_process", object)
    assert open_session(path, providers="auto").get_providers() == ["CPUExecutionProvider"]
    assert not caplog.records


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("silent", r"found no device that it can use; it needs onnxruntime-gpu\[cuda,cudnn\]"),
        ("raising", "first line CUDA failure 100: no device for CUDA"),
    ],
)
def test_a_listed_provider_that_cannot_be_used_is_an_error(path, having, fault, reason):
    """ONNX Runtime itself would continue on the CPU; the message says what is needed."""
    having("CUDA", **{fault: ("CUDA",)})
    with pytest.raises(ConfigError, match=f"'cuda' cannot be used: .*{reason}$"):
        open_session(path, providers=["cuda"])
    with pytest.raises(ConfigError, match=r"^segmenter\.providers: .*model.onnx: provider 'cuda'"):
        OnnxModel(path, 1, "segmenter", "cuda")


def test_all_listed_providers_must_work(path, having):
    """The second of two is checked, too."""
    runtime = having("Tensorrt", "CUDA", silent=("CUDA",))
    with pytest.raises(ConfigError, match="provider 'cuda' cannot be used"):
        open_session(path, providers=["tensorrt", "cuda"])
    assert list(runtime.opened[0]) == ["Tensorrt", "CUDA"]


def test_a_listed_provider_that_is_not_installed_is_an_error(having):
    """What is there, and what to install."""
    having("OpenVINO")
    message = r"'cuda' is not in the installed ONNX Runtime, which has openvino, cpu; install onnx"
    with pytest.raises(ConfigError, match=message):
        requested_providers(["cuda", "cpu"])


def test_a_model_at_fault_is_not_blamed_on_the_provider(path, having, caplog):
    """Every provider would reject it, so no provider is reported, and the error is the model's."""
    having("CUDA", raising=("CUDA",))
    path.write_bytes(b"not a model")
    for providers in ("auto", "cuda"):
        with pytest.raises(runtime_errors()):
            open_session(path, providers=providers)
        with pytest.raises(ModelError, match="not a usable ONNX model"):
            OnnxModel(path, 1, "detector", providers)
    assert not caplog.records


def test_coreml_is_taken_for_inputs_of_fixed_shapes_only(tmp_path, path, having):
    """With free shapes it compiles parts of a model again and again; a list takes it even then."""
    having("CoreML")
    assert open_session(path, providers="auto").get_providers() == ["CPUExecutionProvider"]
    fixed = tmp_path / "fixed.onnx"
    shape = {"image": (TensorProto.FLOAT, (1, 3, 4, 4))}
    constant_model(fixed, {"out": np.zeros((1, 2), "float32")}, inputs=shape)
    for model, providers in ((fixed, "auto"), (path, "coreml")):
        found = open_session(model, providers=providers).get_providers()
        assert found[0] == "CoreMLExecutionProvider"


def test_options_of_the_user_come_before_ours(path, having):
    """By the short name or ONNX Runtime's; options of other providers are not used."""
    runtime = having("CUDA")
    for name in ("cuda", "CUDAExecutionProvider"):
        open_session(path, 1, [name], {name: {"use_tf32": 1, "device_id": 2}, "rocm": {"a": 1}})
    assert runtime.opened == [{"CUDA": {"use_tf32": 1, "device_id": 2}}] * 2


def test_openvino_gets_the_threads_of_the_cpu(path, having):
    """One per worker, like the provider of the CPU."""
    runtime = having("OpenVINO")
    open_session(path, 3, "auto")
    assert runtime.opened == [{"OpenVINO": {"num_of_threads": 3}}]


@pytest.mark.parametrize(("name", "meant"), [("cdua", "cuda"), ("CudaExecutionProvider", None),
                                             ("CUDAExecutionProvidr", "CUDAExecutionProvider"),
                                             ("tensor-rt", "tensorrt"), ("gpu", None)])  # fmt: skip
def test_unknown_names_are_rejected_with_a_suggestion(name, meant):
    """Any other provider of ONNX Runtime goes by ONNX Runtime's own name."""
    if name.endswith("ExecutionProvider"):
        assert provider_named(name).runtime_name == name
        return
    with pytest.raises(ConfigError, match=f"unknown provider '{name}'") as error:
        provider_named(name)
    assert (f"did you mean '{meant}'" in str(error.value)) == (meant is not None)


def test_both_names_of_a_provider_are_the_same_provider():
    for provider in PROVIDERS:
        assert provider_named(provider.name) is provider_named(provider.runtime_name)


@pytest.mark.parametrize(
    ("device", "installed", "providers", "options"),
    [
        ("auto", ("CUDA",), "auto", {}),
        ("cpu", ("CUDA",), "cpu", {}),
        ("cuda", ("CUDA",), ("cuda",), {"cuda": {}}),
        ("cuda:1", ("CUDA",), ("cuda",), {"cuda": {"device_id": 1}}),
        ("cuda:1", ("MIGraphX",), ("migraphx",), {"migraphx": {"device_id": 1}}),
        ("cuda", (), ("cuda",), {"cuda": {}}),
        ("mps", ("CoreML",), ("coreml",), {"coreml": {}}),
        ("xpu", ("OpenVINO",), ("openvino",), {"openvino": {"device_type": "GPU"}}),
        ("xpu:1", ("OpenVINO",), ("openvino",), {"openvino": {"device_type": "GPU.1"}}),
    ],
)
def test_a_device_of_torch_decides_the_provider(having, device, installed, providers, options):
    """AMD's GPUs are "cuda" in torch, too."""
    having(*installed)
    assert providers_of_device(device) == (providers, options)


def test_options_of_the_user_come_before_those_of_the_device(having):
    having("CUDA")
    given = {"cuda": {"device_id": 3, "use_tf32": 1}}
    assert providers_of_device("cuda:1", given)[1] == given


def test_a_device_without_a_provider_is_an_error():
    with pytest.raises(ConfigError, match="no provider for device 'hpu'; list the providers"):
        providers_of_device("hpu")


@pytest.mark.parametrize(
    ("installed", "providers", "options", "exclusive"),
    [
        ((), "auto", {}, False),
        (("CUDA",), "auto", {}, True),
        (("CUDA",), "cpu", {}, False),
        (("OpenVINO",), "auto", {}, False),
        (("OpenVINO",), "auto", {"openvino": {"device_type": "GPU"}}, True),
    ],
)
def test_workers_share_the_cpu_but_no_other_device(
    having, installed, providers, options, exclusive
):
    having(*installed)
    assert is_exclusive(providers, options) == exclusive


def test_the_library_that_cannot_be_loaded_is_the_reason(path, having, monkeypatch, tmp_path):
    """The system's own message, which ONNX Runtime only prints."""
    having("CUDA", silent=("CUDA",))
    libraries = tmp_path / "capi"
    libraries.mkdir()
    (libraries / "libonnxruntime_providers_cuda.so").write_bytes(b"damaged")
    (libraries / "libonnxruntime_providers_cuda.dylib").write_bytes(b"damaged")
    monkeypatch.setattr(onnxruntime, "__file__", str(tmp_path / "__init__.py"))
    with pytest.raises(ConfigError, match=r"cannot be used: .*libonnxruntime_providers_cuda\."):
        open_session(path, providers="cuda")


def test_the_model_gives_the_same_result_on_any_provider(path, having):
    """Our side of a session is the same: inputs and outputs are numpy arrays by name."""
    runtime = having("CUDA")
    model = OnnxModel(path, 1, "detector")
    points = np.ones((2, 4), "float32")
    assert model.run({"points": points})["boxes"].shape == (3, 7)
    assert list(runtime.opened[-1]) == ["CUDA"]


def test_no_path_of_the_model_is_needed_for_a_list(tmp_path):
    """A missing file is the model's fault."""
    with pytest.raises(runtime_errors()):
        open_session(Path(tmp_path / "missing.onnx"), providers="cpu")
