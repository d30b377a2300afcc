"""Where models run: device and providers of the configuration, on machines that are not here."""

import threading
import warnings

import pytest
import torch
from support.fake_providers import FakeRuntime, fake_providers
from support.pipelines_cli import Curate
from support.tiny_onnx import tiny_detector

from curate.detectors.devices import check_device_name, choose_device
from curate.detectors.precision import mixed_precision
from curate.errors import ConfigError, DataError
from curate.warnings_once import warn_once
from pipelines.assembly import check_detector, check_segmenter, made_by, open_detector
from pipelines.devices import ModelPlace, detector_place, idle_gpu, segmenter_place
from pipelines.stages.predict import settings_of_results
from pipelines.stages.reading import FrameReader
from pipelines.stages.score import Score
from pipelines.stages.segment import Segment
from pipelines.stages.train_round import loaders
from pipelines.workspace.config import make_config


def config(**sections):
    """Return a configuration with these sections."""
    return make_config({"dataset": {"root": "."}, **sections}, "test")


@pytest.fixture
def gpu(monkeypatch):
    """Pretend that torch has been built for CUDA and finds a GPU."""
    monkeypatch.setattr("curate.detectors.devices.version", lambda name: "2.13.0+cu128")
    monkeypatch.setattr(torch.accelerator, "is_available", lambda: True)
    monkeypatch.setattr(torch.accelerator, "current_accelerator", lambda: torch.device("cuda"))


@pytest.mark.parametrize(
    ("detector", "without", "with_gpu"),
    [
        ({}, ModelPlace(providers="cpu"), ModelPlace("cuda")),
        ({"device": "cpu"}, ModelPlace(providers="cpu"), ModelPlace(providers="cpu")),
        ({"device": "cuda:1"}, ModelPlace("cuda:1"), ModelPlace("cuda:1")),
        ({"providers": "cuda"}, ModelPlace(providers=("cuda",)), ModelPlace(providers=("cuda",))),
        ({"name": "onnx"}, ModelPlace(), ModelPlace()),
        (
            {"name": "onnx", "device": "cpu"},
            ModelPlace(providers="cpu"),
            ModelPlace(providers="cpu"),
        ),
        ({"name": "recorded", "device": "cpu"}, None, None),
        ({"name": "support.fake_providers:DetectorInTorch"}, ModelPlace("cpu"), ModelPlace("cuda")),
    ],
)
def test_one_rule_for_torch_and_onnx_runtime(detector, without, with_gpu, request):
    """Pillars runs in torch on a GPU, in ONNX Runtime on the CPU and on listed providers."""
    assert detector_place(config(detector=detector)) == without
    request.getfixturevalue("gpu")
    assert detector_place(config(detector=detector)) == with_gpu


def test_the_device_chooses_the_provider_of_a_model_in_onnx(monkeypatch):
    """With its number as an option."""
    fake_providers(monkeypatch, FakeRuntime(("CUDA",)))
    found = detector_place(config(detector={"name": "onnx", "device": "cuda:1"}))
    assert found == ModelPlace(None, ("cuda",), {"cuda": {"device_id": 1}})
    assert found.exclusive
    check_detector(config(detector={"name": "onnx", "device": "cuda:1", "path": "a.onnx"}))


def test_the_torch_library_is_not_imported_where_it_has_no_gpu(monkeypatch):
    """Its CPU build has none; importing it would take a second and 200 MB in each worker."""
    monkeypatch.setattr("curate.detectors.devices.version", lambda name: "2.13.0+cpu")
    monkeypatch.setattr(torch, "accelerator", None)
    assert choose_device("auto") == "cpu"


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"detector": {"providers": "cdua"}}, "detector.providers: unknown provider 'cdua'.*cuda'"),
        ({"segmenter": {"providers": ["cuda", "cuda"]}}, "segmenter.providers: 'cuda' is listed "),
        ({"segmenter": {"providers": []}}, "segmenter.providers: .* use a list of cuda, .*auto"),
        ({"detector": {"provider_options": {"cud": {}}}}, "provider_options.*did you mean 'cuda'"),
        ({"detector": {"provider_options": {"cuda": {"a": [1]}}}}, r"cuda.a = \[1\]: use a string"),
        ({"detector": {"device": "gpu"}}, "detector.device: unknown device 'gpu': .*'cuda'"),
        ({"detector": {"device": "cudda:1"}}, "unknown device 'cudda:1'.*did you mean 'cuda'"),
        ({"detector": {"device": "auto:1"}}, "unknown device 'auto:1'"),
    ],
)  # fmt: skip
def test_wrong_names_are_rejected_when_the_configuration_is_read(sections, message):
    """One line, with what was meant."""
    with pytest.raises(ConfigError, match=message):
        config(**sections)


@pytest.mark.parametrize("name", ["auto", "cpu", "cuda", "cuda:3", "mps", "xpu:0", "npu", "hpu"])
def test_any_device_of_torch_can_be_named(name):
    check_device_name(name)


@pytest.mark.parametrize(
    ("detector", "message"),
    [
        ({"device": "cuda:99"}, "detector.device: device 'cuda:99' cannot be used by torch"),
        ({"device": "npu"}, "detector.device: device 'npu' cannot be used by torch"),
        ({"name": "recorded", "providers": "cpu"}, "detector.providers: .* not run in ONNX Runt"),
        ({"name": "recorded", "provider_options": {"cpu": {}}}, "detector.provider_options: .* no"),
        ({"providers": "cuda"}, "detector.providers: provider 'cuda' is not in the installed"),
        ({"name": "onnx", "device": "cuda"}, "detector.device: provider 'cuda' is not in the inst"),
        ({"name": "onnx", "device": "hpu"}, "detector.device: ONNX Runtime has no provider for d"),
    ],
)  # fmt: skip
def test_what_is_not_there_is_an_error_before_the_first_frame(detector, message, tmp_path):
    """Without a listed device or provider nothing is an error: the CPU is always there."""
    section = {"path": str(tmp_path), **detector}
    with pytest.raises(ConfigError, match=message):
        check_detector(config(detector=section))
    kept = {key: value for key, value in section.items() if key in {"name", "path"}}
    check_detector(config(detector=kept))


def test_a_segmenter_without_a_model_rejects_providers():
    """Saved maps run nowhere."""
    saved = {"name": "saved", "path": "maps", "classes": "voc"}
    check_segmenter(config(segmenter=saved))
    with pytest.raises(ConfigError, match=r"segmenter\.providers: .* remove the setting"):
        check_segmenter(config(segmenter={**saved, "providers": ["cpu"]}))


def test_providers_and_their_options_reach_the_model(monkeypatch, tmp_path):
    """From the configuration to the session."""
    runtime = fake_providers(monkeypatch, FakeRuntime(("CUDA",)))
    tiny_detector(tmp_path / "a.onnx")
    section = {"name": "onnx", "path": str(tmp_path / "a.onnx"), "providers": ["cuda"]}
    section["provider_options"] = {"cuda": {"device_id": 1}}
    open_detector(config(detector=section), tmp_path / "a.onnx")
    assert runtime.opened == [{"CUDA": {"use_tf32": 0, "device_id": 1}}]


@pytest.mark.parametrize(
    ("detector", "options", "message"),
    [
        (
            {"providers": ["cuda"]}, {"cuda": {"devise_id": 1, "use_tf32": 1}},
            "provider 'cuda' has no option 'devise_id'; did you mean 'device_id'?",
        ),
        ({"providers": "cpu"}, {"cpu": {"threads": 2}}, "provider 'cpu' has no option 'threads'"),
        (
            {"device": "cpu"}, {"cuda": {"device_id": 1}},
            "provider 'cuda' is not used, so its options have no effect",
        ),
        (
            {"name": "onnx"}, {"tensorrt": {"trt_fp16_enable": True}},
            "'auto' never takes provider 'tensorrt', so its options have no effect; list it",
        ),
        ({"name": "onnx"}, {"cuda": {"device_id": 1}, "openvino": {"device_type": "GPU"}}, None),
        ({"providers": "VitisAIExecutionProvider"}, {"VitisAIExecutionProvider": {"new": 1}}, None),
    ],
)  # fmt: skip
def test_options_that_would_be_ignored_are_reported_at_the_start(
    detector, options, message, monkeypatch, caplog, tmp_path
):
    """Once, before a model is loaded; ONNX Runtime ignores some, and fails late on others."""
    warn_once.cache_clear()
    fake_providers(monkeypatch, FakeRuntime(("CUDA", "VitisAI")))
    section = {"path": str(tmp_path), "provider_options": options, **detector}
    for _ in range(2):
        check_detector(config(detector=section))
    assert caplog.messages == ([f"detector.provider_options: {message}"] if message else [])


def test_options_of_providers_have_no_effect_in_torch(monkeypatch, caplog, tmp_path):
    """A detector that can run in both runs in torch on a GPU."""
    warn_once.cache_clear()
    monkeypatch.setattr("pipelines.devices.choose_device", lambda device: "cuda")
    options = {"cuda": {"device_id": 1}}
    check_detector(config(detector={"path": str(tmp_path), "provider_options": options}))
    assert caplog.messages == [
        "detector.provider_options have no effect: the model runs in torch on cuda"
    ]


def test_results_of_another_device_or_provider_stay_valid():
    """Options of providers may lower the precision, so they count."""
    first = settings_of_results(config().detector)
    for same in ({"device": "cpu"}, {"device": "cuda"}, {"providers": ["cuda"]}):
        assert settings_of_results(config(detector=same).detector) == first
    other = {"provider_options": {"tensorrt": {"trt_fp16_enable": True}}}
    assert settings_of_results(config(detector=other).detector) != first
    assert not {"providers", "provider_options"} & first.keys()


def test_stored_maps_depend_on_the_options_of_providers_alone():
    """TensorRT's half precision gives other maps; another provider gives the same."""
    simulated = {"name": "simulated"}
    first = made_by(config(segmenter=simulated))
    assert made_by(config(segmenter={**simulated, "providers": "cpu"})) == first
    other = {**simulated, "provider_options": {"tensorrt": {"trt_fp16_enable": True}}}
    assert made_by(config(segmenter=other)) != first


@pytest.mark.parametrize("kind", [Segment, lambda each: Score(each, "semantic", {})])
def test_workers_do_not_share_the_gpu_of_a_segmenter(kind, monkeypatch):
    section = {"name": "simulated", "providers": "cpu"}
    assert kind(config(segmenter=section)).workers is None
    fake_providers(monkeypatch, FakeRuntime(("CUDA",)))
    gpu = kind(config(segmenter={**section, "providers": "cuda"}))
    assert (gpu.exclusive, gpu.workers) == (True, 1)


def test_an_idle_gpu_is_noticed(monkeypatch):
    """Where NVIDIA's tools are installed, and no model runs on a device of its own."""
    monkeypatch.setattr("pipelines.devices.shutil.which", lambda name: f"/usr/bin/{name}")
    assert idle_gpu(ModelPlace(providers="cpu"), None)
    assert not idle_gpu(ModelPlace("cuda"), ModelPlace(providers="cpu"))
    assert not idle_gpu(None, None)
    monkeypatch.setattr("pipelines.devices.shutil.which", lambda name: None)
    assert not idle_gpu(ModelPlace(providers="cpu"))


def test_the_segmenter_that_is_shipped_runs_in_onnx_runtime():
    assert segmenter_place(config(segmenter={"name": "simulated"})) == ModelPlace()
    assert segmenter_place(config()) is None


def test_doctor_says_where_models_run(curate: Curate, tmp_path, toy_kitti, monkeypatch):
    """And which providers follow if the first one fails."""
    fake_providers(monkeypatch, FakeRuntime(("CUDA",)))
    tiny_detector(tmp_path / "a.onnx")
    code, _, err = curate(
        "init", tmp_path / "w", "--root", toy_kitti, "--labeled", "0.25", "--detector", "onnx",
        "--detector-path", tmp_path / "a.onnx", "--set", 'run.priors=["points"]',
    )  # fmt: skip
    assert code == 0, err
    _, out, _ = curate("doctor", "-w", tmp_path / "w")
    assert "ok       devices      detector in ONNX Runtime on cuda, or cpu" in out


@pytest.mark.parametrize(
    ("cores", "device", "section", "expected"),
    [(16, "cpu", {}, 0), (16, "cuda", {}, 8), (4, "mps", {}, 3), (1, "cuda", {}, 0),
     (16, "cpu", {"loaders": 2}, 2), (16, "cuda", {"loaders": 0}, 0)],
)  # fmt: skip
def test_batches_are_prepared_by_other_processes_where_there_is_a_gpu(
    monkeypatch, cores, device, section, expected
):
    monkeypatch.setattr("pipelines.stages.train_round.usable_cores", lambda: cores)
    monkeypatch.setattr("pipelines.stages.train_round.affordable_workers", lambda number: number)
    assert loaders(config(train=section).train, device) == expected


def test_a_mixed_precision_needs_a_detector_in_torch(gpu, tmp_path):
    """Pillars on the CPU then runs in torch, too; a model in ONNX has the precision of its file."""
    assert detector_place(config(detector={"device": "cpu", "precision": "bfloat16"})) == (
        ModelPlace("cpu")
    )
    check_detector(config(detector={"device": "cpu", "precision": "bfloat16"}))
    for other in ({"name": "onnx"}, {"name": "recorded"}, {"providers": ["cpu"]}):
        section = {"path": str(tmp_path), "precision": "bfloat16", **other}
        with pytest.raises(ConfigError, match=r"detector\.precision: .*remove the setting"):
            check_detector(config(detector=section))


def test_float16_on_the_cpu_is_reported_once(caplog, gpu):
    """It is many times slower; bfloat16 is not."""
    warn_once.cache_clear()
    for precision in ("bfloat16", "float16", "float16"):
        check_detector(config(detector={"device": "cpu", "precision": precision}))
    [message] = caplog.messages
    assert message.startswith("precision 'float16' is many times slower than 'float32' on the CPU")


def test_a_precision_that_torch_would_not_use_is_an_error(monkeypatch):
    """Torch itself warns and computes in float32."""

    def autocast(kind, dtype):
        warnings.warn(f"In {kind} autocast, but the target dtype is not supported", stacklevel=1)

    monkeypatch.setattr(torch, "autocast", autocast)
    with pytest.raises(ConfigError, match="precision 'bfloat16' cannot be used on mps: In mps"):
        mixed_precision("bfloat16", "mps")


def test_a_precision_is_part_of_what_results_depend_on():
    """Unless it is the default: results from before the setting stay valid."""
    first = settings_of_results(config().detector)
    assert "precision" not in first
    other = config(detector={"precision": "bfloat16"}).detector
    assert settings_of_results(other)["precision"] == "bfloat16"


def test_frames_are_read_in_threads_once_announced():
    """Each once; an error appears where the frame is needed."""
    threads = []

    def read(name):
        threads.append((name, threading.current_thread() is threading.main_thread()))
        if name == "b":
            raise DataError("frame b is damaged")
        return name

    reader = FrameReader(read)
    reader.announce("ab")
    assert reader("a") == "a"
    with pytest.raises(DataError, match="frame b is damaged"):
        reader("b")
    assert reader("c") == "c"
    assert sorted(threads) == [("a", False), ("b", False), ("c", True)]
