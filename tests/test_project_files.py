"""The project files agree with the code."""

import re
import tomllib

import pytest
import yaml
from support.paths import ROOT

import curate

YAML = sorted([
    *ROOT.glob(".github/**/*.yml"), ROOT / "CITATION.cff", ROOT / ".pre-commit-config.yaml",
])  # fmt: skip


def test_the_version_is_the_same_everywhere() -> None:
    """In the code, the citation and the newest entry of the changelog."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    newest = re.search(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None
    assert curate.__version__ == citation["version"] == newest[1]


def test_the_licence_is_the_same_everywhere() -> None:
    """In the metadata, the citation and the licence file."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert project["license"] == citation["license"] == "Apache-2.0"
    for name in project["license-files"]:
        text = " ".join((ROOT / name).read_text().split())
        assert text.startswith("Apache License Version 2.0, January 2004")
        assert "END OF TERMS AND CONDITIONS" in text


@pytest.mark.parametrize("path", YAML, ids=lambda path: str(path.relative_to(ROOT)))
def test_yaml_files_are_mappings(path) -> None:
    assert isinstance(yaml.safe_load(path.read_text()), dict)


def test_the_workflows_use_existing_targets_and_scripts() -> None:
    """Each `make` target is in the Makefile, and each script in the checkout."""
    makefile = (ROOT / "Makefile").read_text()
    targets = set(re.findall(r"^(\w[\w-]*):", makefile, re.MULTILINE))
    for path in ROOT.glob(".github/workflows/*.yml"):
        jobs = yaml.safe_load(path.read_text())["jobs"]
        commands = "\n".join(step.get("run", "") for job in jobs.values() for step in job["steps"])
        assert set(re.findall(r"\bmake ([\w-]+)", commands)) <= targets
        scripts = re.findall(r"\.ci/\w+\.py", commands)
        assert scripts
        assert all((ROOT / script).exists() for script in scripts)


def test_the_workflows_run_every_supported_python() -> None:
    """The versions of the classifiers."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    prefix = "Programming Language :: Python :: "
    versions = [line.removeprefix(prefix) for line in project["classifiers"] if prefix in line]
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    tested = workflow["jobs"]["test"]["strategy"]["matrix"]["python"]
    assert tested == [version for version in versions if re.fullmatch(r"3\.\d+", version)]
    assert f">={tested[0]}" == project["requires-python"]
