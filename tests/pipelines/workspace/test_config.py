"""The settings of a workspace: each described, checked, and reported if it is wrong."""

import json
import tomllib
from functools import reduce
from operator import getitem
from pathlib import Path

import jsonschema
import pytest

from curate.errors import ConfigError
from pipelines import registry
from pipelines.workspace.config import Config, change_setting, make_config, read_config
from pipelines.workspace.config_file import SCHEMA_NAME, change_settings, write_config
from pipelines.workspace.reference import Setting, is_number, sections_of, settings_of

SETTINGS = {
    f"{name}.{setting.key}": setting
    for name, section in sections_of(Config)
    for setting in settings_of(section)
}
REGISTRIES = {
    "dataset.kind": registry.DATASETS,
    "detector.name": registry.DETECTORS,
    "segmenter.name": registry.SEGMENTERS,
    "run.method": registry.POLICIES,
    "run.executor": registry.EXECUTORS,
    "train.labels_format": registry.EXPORTERS,
}


def test_every_section_of_the_configuration_is_tested() -> None:
    """So that the tests below miss none."""
    names = [name for name, _ in sections_of(Config)]
    assert [name for name in names if "." not in name] == list(Config.model_fields)
    assert names[names.index("solve") + 1] == "solve.learned"
    assert len(SETTINGS) > 50


@pytest.mark.parametrize("setting", SETTINGS.values(), ids=SETTINGS.keys())
def test_every_setting_has_a_description(setting: Setting) -> None:
    """A sentence, a unit if and only if it is a number, and an example if it is unset."""
    assert setting.meaning[0].isupper()
    assert setting.meaning.endswith(".")
    assert setting.accepted.type != "value"
    assert bool(setting.unit) == is_number(setting)
    assert bool(setting.example) == (setting.default == "")


@pytest.mark.parametrize("name", [name for name, each in SETTINGS.items() if is_number(each)])
def test_every_number_has_a_range_that_is_checked(name: str) -> None:
    """For infinity and a number below every range, the error contains the range."""
    assert SETTINGS[name].accepted.range
    listed = SETTINGS[name].accepted.type.startswith("list")
    for value in ("-1e300", "inf", "nan"):
        with pytest.raises(ConfigError) as caught:
            change_setting({}, f"{name}={f'[{value}, {value}]' if listed else value}")
        assert f"--set {name}" in str(caught.value)
        assert SETTINGS[name].accepted.range in str(caught.value)


@pytest.mark.parametrize("name", SETTINGS)
def test_every_default_is_accepted(name: str) -> None:
    """And so is every example."""
    setting = SETTINGS[name]
    document: dict = {}
    change_setting(document, f"{name}={setting.default or setting.example or 'somewhere'}")
    *sections, key = name.split(".")
    assert key in reduce(getitem, sections, document)


@pytest.mark.parametrize("name", SETTINGS)
def test_every_misspelled_key_is_reported(name: str) -> None:
    """With its name and the keys of the section."""
    section, _, key = name.rpartition(".")
    with pytest.raises(ConfigError) as caught:
        change_setting({}, f"{section}.{key}x=1")
    words = str(caught.value)
    assert words.startswith(f"--set {name}x: unknown key; did you mean '{key}'?; [{section}] has ")
    assert_no_pydantic_text(words)


@pytest.mark.parametrize("name", [name for name, each in SETTINGS.items() if each.accepted.choices])
def test_every_misspelled_choice_is_reported(name: str) -> None:
    """Registered names and fixed choices; the error lists all of them."""
    choices = SETTINGS[name].accepted.choices
    wrong = choices[0] + "x"
    with pytest.raises(ConfigError) as caught:
        value = f'["{wrong}"]' if name == "run.priors" else wrong
        change_setting({}, f"{name}={value}")
    words = str(caught.value)
    assert words.startswith(f"--set {name}")
    assert f"did you mean '{choices[0]}'?" in words
    assert all(choice in words for choice in choices)
    assert_no_pydantic_text(words)


@pytest.mark.parametrize(("name", "found"), REGISTRIES.items())
def test_registered_names_and_user_supplied_classes_are_accepted(
    name: str, found: registry.Registry
) -> None:
    """Without importing them."""
    assert set(SETTINGS[name].accepted.choices) >= set(found.classes)
    for value in (*found.classes, "no_such_module:Class"):
        change_setting({}, f"{name}={value}")


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("slve.scope=round", "slve: unknown section; did you mean 'solve'?; the configuration has"),
        ("run.threads=3", "run.threads: unknown key; did you mean train.threads?; [run] has "),
        ("run.workers=many", 'run.workers = "many": use a whole number, at least 1, or "auto"'),
        ("run.workers=1.5", 'run.workers = 1.5: use a whole number, at least 1, or "auto"'),
        ("solve.self_paced=flase", 'solve.self_paced = "flase": use true or false'),
        ("dataset.root=3", "dataset.root = 3: use a path"),
        ("dataset.categories=Car", 'dataset.categories = "Car": use a list of strings'),
        ("dataset.categories=[1, 2]", "dataset.categories: 1 in the list: use a list of strings"),
        ('dataset.categories=["Car", "Car"]', "dataset.categories: 'Car' is listed twice"),
        (
            "repredict.scale_range=[1, 101]",
            "repredict.scale_range: 101 in the list: use a list of two numbers, above 0 and at",
        ),
        (
            "repredict.scale_range=[1.2, 0.8]",
            "repredict.scale_range: the lower limit must come first",
        ),
        ("train.options=3", "train.options = 3: use a table"),
        ("solve.options.threshold=3", "solve.options.threshold = 3: use a table"),
        (
            "solve.options.thresold.threshold=0.4",
            "solve.options.thresold: unknown policy 'thresold': use one of 3dioumatch",
        ),
        ("solve.policy=spsl", 'solve: policy has moved: write method = "spsl" in [run]'),
    ],
)
def test_a_wrong_setting_is_reported(setting: str, words: str) -> None:
    """With its key and the accepted values."""
    with pytest.raises(ConfigError) as caught:
        change_setting({}, setting)
    assert str(caught.value).startswith(f"--set {words}")
    assert_no_pydantic_text(str(caught.value))


def test_all_errors_of_a_file_are_one_line(tmp_path: Path) -> None:
    """With the file, and each key once."""
    path = tmp_path / "curate.toml"
    path.write_text(
        'solve = 3\n[detecter]\nname = "x"\n[dataset]\nkind = "kiti"\n[train]\nround_stpes = 3\n'
    )
    with pytest.raises(ConfigError) as caught:
        read_config(path)
    words = str(caught.value)
    assert words.startswith(f"{path}: ")
    assert "dataset.root is missing: Folder of the data set." in words
    assert "detecter: unknown section; did you mean 'detector'?" in words
    assert "train.round_stpes: unknown key; did you mean 'round_steps'?" in words
    assert "dataset.kind: unknown dataset 'kiti'" in words
    assert "solve = 3: use a table" in words
    assert_no_pydantic_text(words)


def assert_no_pydantic_text(message: str) -> None:
    """Check that a message is one line without a phrase of pydantic."""
    assert "\n" not in message
    for phrase in ("Input should", "Extra inputs", "not permitted", "valid ", "type=", "pydantic"):
        assert phrase not in message


def test_a_written_file_contains_and_explains_every_setting(tmp_path: Path) -> None:
    """Unset settings are comments with an example; the file can be read back."""
    config = make_config(
        {"dataset": {"root": "data"}, "solve": {"options": {"my.lab:Policy": {"a": 1}}}}, "test"
    )
    path = tmp_path / "curate.toml"
    write_config(path, config)
    assert read_config(path) == config
    text = path.read_text()
    values = tomllib.loads(text)
    for name, setting in SETTINGS.items():
        section, _, key = name.rpartition(".")
        written = reduce(getitem, section.split("."), values)
        lines = text.partition(f"\n[{section}]\n")[2].partition("\n[")[0].splitlines()
        assert setting.meaning in " ".join(line.removeprefix("# ") for line in lines)
        assert (key in written) != (f"# {key} = {setting.example}" in lines)
    assert max(map(len, text.splitlines())) <= 100
    assert "\n# Number of rounds E. At least 1, in rounds.\nrounds = 3\n" in text
    assert "or module:Class.\n" in text


def test_a_commented_setting_can_be_uncommented(tmp_path: Path) -> None:
    """Its example is valid as it is."""
    path = tmp_path / "curate.toml"
    write_config(path, make_config({"dataset": {"root": "data"}}, "test"))
    path.write_text(path.read_text().replace("# quantile = 0.95", "quantile = 0.95"))
    assert read_config(path).solve.quantile == 0.95


def test_a_changed_setting_replaces_its_comment(tmp_path: Path) -> None:
    """Every other line of the file stays."""
    path = tmp_path / "curate.toml"
    write_config(path, make_config({"dataset": {"root": "data"}}, "test"))
    before = path.read_text().splitlines()
    change_settings(path, "train", {"command": "./train.sh", "labels_format": "kitti"})
    after = path.read_text().splitlines()
    assert [(old, new) for old, new in zip(before, after, strict=True) if old != new] == [
        ('# command = "python train.py {labels} {output}"', 'command = "./train.sh"'),
        ('labels_format = "sqlite"', 'labels_format = "kitti"'),
    ]


def test_the_schema_that_a_file_refers_to_is_beside_it(tmp_path: Path) -> None:
    """It accepts what curate writes and rejects what curate rejects."""
    path = tmp_path / "curate.toml"
    write_config(path, make_config({"dataset": {"root": "data"}}, "test"))
    first = path.read_text().partition("\n")[0]
    assert first == f"#:schema ./{SCHEMA_NAME}"
    schema = json.loads((tmp_path / first.removeprefix("#:schema ")).read_text())
    check = jsonschema.Draft202012Validator(schema)
    document = tomllib.loads(path.read_text())
    check.validate(document)
    for name, value, fits in (
        ("detector.name", "pilars", False),
        ("detector.name", "my.lab:Detector", True),
        ("detector.nme", "pillars", False),
        ("segmenter.classes", "cityscape", False),
        ("run.workers", 0, False),
        ("run.priors", ["pointz"], False),
    ):
        section, key = name.split(".")
        changed = document | {section: document[section] | {key: value}}
        assert check.is_valid(changed) == fits, name
