"""`from curate import ...`: the names, lazy loading, and what type checkers see."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest
from support.paths import ROOT

import curate

SOURCE = ast.parse(Path(curate.__file__).read_text())


def python(code: str) -> str:
    """Return what a new interpreter prints."""
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.strip()


def test_the_lists_of_names_agree() -> None:
    """Those for type checkers, for `import *`, and for lazy loading."""
    [block] = [
        node
        for node in SOURCE.body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    ]
    for_checkers = {
        (alias.name, node.module)
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    for_loading = {
        (name, module)
        for modules in curate.PUBLIC_MODULES.values()
        for module, names in modules.items()
        for name in names
    }
    assert for_checkers == for_loading
    assert {name for name, _ in for_loading} == set(curate.__all__)
    assert len(set(curate.__all__)) == len(curate.__all__)
    assert set(curate.__all__) <= set(dir(curate))


@pytest.mark.parametrize("name", curate.__all__)
def test_every_name_is_documented(name: str) -> None:
    """It can be loaded, has the same name in its module, and has its own docstring."""
    found = getattr(curate, name)
    if name != "CATEGORIES":
        assert found.__name__ == name
        assert (inspect.getdoc(found) or "").strip().endswith((".", "`", ")"))


@pytest.mark.parametrize("name", curate.__all__)
def test_paths_can_be_text_or_path(name: str) -> None:
    """No public function requires a `Path`."""
    found = getattr(curate, name)
    if callable(found):
        try:
            parameters = inspect.signature(found).parameters.values()
        except ValueError:
            return
        insisting = [each.name for each in parameters if each.annotation in (Path, Path | None)]
        assert insisting == []


def test_an_unknown_name_is_an_attribute_error() -> None:
    """`hasattr` works."""
    assert not hasattr(curate, "Detection")
    with pytest.raises(ImportError, match="cannot import name 'Detection'"):
        from curate import Detection  # noqa: F401


def test_importing_loads_no_heavy_library() -> None:
    """Neither torch nor numba nor numpy, until a name needs them."""
    code = "import sys, curate; print({'numpy', 'numba', 'torch', 'pandas'} & set(sys.modules))"
    assert python(code) == "set()"
    code = "import sys; from curate import Detections; print({'numba', 'torch'} & set(sys.modules))"
    assert python(code) == "set()"


@pytest.mark.slow
def test_type_checkers_see_the_names(tmp_path: Path) -> None:
    """Mypy knows the types of imported names, and of tables by library."""
    mypy = pytest.importorskip("mypy.api", reason="mypy is not installed")
    script = tmp_path / "notebook.py"
    script.write_text(
        "from curate import Detections, bev_iou, read_labels\n"
        "reveal_type(Detections.empty().boxes)\n"
        "reveal_type(bev_iou)\n"
        "reveal_type(read_labels('labels.sqlite', 'pandas'))\n"
        "from curate import Detection\n"
    )
    shown, _, _ = mypy.run(
        ["--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", str(tmp_path), str(script)]
    )
    assert 'Revealed type is "numpy.ndarray' in shown
    assert 'Revealed type is "def (boxes_a: numpy.ndarray' in shown
    assert 'Module "curate" has no attribute "Detection"' in shown


def test_the_packages_are_marked_as_typed() -> None:
    """Otherwise type checkers ignore them once they are installed (PEP 561)."""
    assert all((ROOT / package / "py.typed").exists() for package in ("curate", "db", "pipelines"))
