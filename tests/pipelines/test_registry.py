"""User-supplied classes, and modules that fail on import."""

from pathlib import Path
from zlib import crc32

import pytest

from curate.errors import ConfigError
from pipelines.registry import DETECTORS, PRIORS, detector_and_preset


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("raise RuntimeError('no\\nlicence')", "raises RuntimeError: no licence"),
        ("raise SystemExit(0)", "raises SystemExit: 0"),
        ("def f(", "raises SyntaxError"),
        ("Mine = 3", "is not a class but 3"),
        ("", "cannot be imported"),
        ("class Mine: ...", "has no predict; see curate.detectors.base.Detector"),
    ],
)
def test_a_module_that_fails_on_import_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, words: str
) -> None:
    """One line, and in particular not exit code 0 as if all had been done."""
    name = f"of_a_user_{crc32(source.encode())}"
    (tmp_path / f"{name}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=f"^detector '{name}:Mine' .*{words}") as found:
        DETECTORS.load(f"{name}:Mine")
    assert "\n" not in str(found.value)


def test_a_class_without_the_required_members_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Methods and class attributes are required; instance attributes may be set later."""
    (tmp_path / "priors_of_a_user.py").write_text(
        "class Mine:\n    name = 'mine'\n    measured_columns = ()\n"
        "    def measure(self, frame, detections): ...\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(
        ConfigError, match=r"^prior '.*' has no columns, rho_column, further_columns; see"
    ):
        PRIORS.load("priors_of_a_user:Mine")


SOURCE = """
class Mine:
    def __init__(self, path, *, minimum_score, device="cpu"):
        self.device = device
    def predict(self, frame): ...

class Anything(Mine):
    def __init__(self, path, **options):
        self.options = options
"""


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("pilars", {}, "unknown detector 'pilars': use one of .*; did you mean 'pillars'\\?$"),
        ("no_such_package.a:B", {}, "No module named .*; install it, or add its folder to PYTHON"),
        ("{}:Mien", {}, "cannot be imported: {} has no 'Mien'; did you mean 'Mine'\\?$"),
        (
            "{}:Mine",
            {"devise": "cuda"},
            "has no option 'devise'; did you mean 'device'\\?; it has minimum_score, device$",
        ),
        ("{}:Mine", {}, "missing a required .*argument: 'minimum_score'$"),
    ],
)
def test_a_wrong_name_or_option_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, options: dict, words: str
) -> None:
    """Without creating an instance."""
    module = "detectors_of_a_user"
    (tmp_path / f"{module}.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=words.format(module)):
        DETECTORS.check(name.format(module), None, offered=(), options=options)


def test_a_class_that_accepts_any_option_gets_all_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "open_detectors_of_a_user.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    made = DETECTORS.build(
        "open_detectors_of_a_user:Anything", None, offered={}, options={"anything": 1}
    )
    assert made.options == {"anything": 1}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("pillars", ("pillars", None)),
        ("voxel-rcnn", ("openpcdet", "voxel-rcnn")),
        ("second-small", ("openpcdet", "second-small")),
        ("module:Class", ("module:Class", None)),
        ("small", ("pillars", "small")),
    ],
)
def test_a_preset_names_its_detector(name: str, expected: tuple) -> None:
    assert detector_and_preset(name) == expected


@pytest.mark.parametrize(
    ("name", "meant"), [("voxel-rcn", "voxel-rcnn"), ("pillar", "pillars"), ("kiti", "kitti")]
)
def test_a_misspelled_preset_is_suggested(name: str, meant: str) -> None:
    with pytest.raises(ConfigError, match=f"unknown detector '{name}'.*did you mean '{meant}'"):
        detector_and_preset(name)
