"""Architecture: allowed imports between modules, and forbidden calls."""

import ast
import subprocess
import tomllib
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from itertools import chain
from pathlib import Path

import pytest
from support.paths import ROOT

# pipelines -> db -> curate, pipelines -> curate; never back.
MAY_IMPORT = {
    "curate": {"curate"},
    "db": {"db", "curate"},
    "pipelines": {"pipelines", "db", "curate"},
}
# The subpackages of each package, from the bottom up: each imports only those before it.
LAYERS = {
    "curate": (
        "shapes", "ranges", "errors", "spelling", "warnings_once", "files", "option_values",
        "frames", "geometry", "detections", "consistency", "datasets", "category_names",
        "simulation", "segmenters", "priors", "calibration", "weighting", "evaluation", "exporters",
        "detectors", "firewall", "viewing", "review", "training", "__main__",
    ),
    "pipelines": (
        "user_modules", "registry", "workspace", "devices", "assembly", "category_names", "engine",
        "labels", "firewall", "review", "stages", "round", "assessment", "queries", "reports",
        "serving", "bench", "demo", "commands", "cli", "__main__",
    ),
}  # fmt: skip
MODULES = sorted(path for folder in MAY_IMPORT for path in (ROOT / folder).rglob("*.py"))


def imports(path: Path) -> Iterator[str]:
    """Yield the modules that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path: Path) -> None:
    """A module imports only from its own package and those below it."""
    folder = path.relative_to(ROOT).parts[0]
    own = {name.split(".")[0] for name in imports(path)} & set(MAY_IMPORT)
    assert own <= MAY_IMPORT[folder]


def module_name(path: Path) -> str:
    """Return the dotted name of a file's module."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def import_graph() -> dict[str, set[str]]:
    """Return the modules that each module imports, deferred imports included."""
    modules = {module_name(path): path for path in MODULES}
    graph: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        for node in ast.walk(ast.parse(path.read_text())):
            found = []
            if isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                # A name imported from a package may be one of its modules.
                inner = [f"{node.module}.{alias.name}" for alias in node.names]
                found = [each if each in modules else node.module for each in inner]
            graph[name] |= {each for each in found if each in modules and each != name}
    return graph


def test_there_are_no_import_cycles() -> None:
    """Imports inside functions included."""
    try:
        TopologicalSorter(import_graph()).prepare()
    except CycleError as circle:
        pytest.fail(" -> ".join(circle.args[1]))


def test_subpackages_import_only_lower_ones() -> None:
    """Every subpackage has its place in LAYERS."""
    upward = []
    for name, imported in import_graph().items():
        for other in imported:
            package, subpackage, other_subpackage = (
                name.split(".")[0],
                subpackage_of(name),
                subpackage_of(other),
            )
            if (
                package != other.split(".")[0]
                or package not in LAYERS
                or subpackage == other_subpackage
            ):
                continue
            # The package itself collects the public names, so it is above all of its subpackages.
            layers = (*LAYERS[package], "")
            if layers.index(other_subpackage) > layers.index(subpackage):
                upward.append(f"{name} -> {other}")
    assert upward == []


def subpackage_of(module: str) -> str:
    """Return the folder or file of a module within its package; "" for the package itself."""
    return module.partition(".")[2].partition(".")[0]


def test_every_subpackage_is_in_the_layers() -> None:
    """A new file or folder at the top of a package must be added to LAYERS."""
    for package, layers in LAYERS.items():
        own = [path for path in MODULES if path.relative_to(ROOT).parts[0] == package]
        assert {subpackage_of(module_name(path)) for path in own} - {""} == set(layers)


def test_curate_works_without_db_and_pipelines() -> None:
    """A user's own db.py does no harm then."""
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in MODULES
        if path.relative_to(ROOT).parts[0] == "curate"
    ]
    code = (
        "import sys, importlib\n"
        "sys.modules['db'] = sys.modules['pipelines'] = None\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
    )
    python = ROOT / ".venv" / "bin" / "python"
    import sys

    subprocess.run(
        [python if python.exists() else sys.executable, "-c", code], check=True, cwd=ROOT
    )


def test_only_the_label_file_format_uses_sql_in_curate() -> None:
    users = {
        str(path.relative_to(ROOT))
        for path in MODULES
        if {"sqlite3", "sqlalchemy"} & {name.split(".")[0] for name in imports(path)}
        and path.relative_to(ROOT).parts[0] == "curate"
    }
    assert users <= {
        "curate/exporters/label_file.py",
        "curate/exporters/sqlite.py",
        "curate/training/labels.py",
    }


def test_every_module_has_a_docstring() -> None:
    undocumented = [
        str(path) for path in MODULES if not ast.get_docstring(ast.parse(path.read_text()))
    ]
    assert undocumented == []


# Calls that run code from a file, unpack archives, or start a shell.
RUNS_FOREIGN_CODE = {
    "eval", "exec", "compile", "__import__", "os.system", "os.popen",
    "pickle.load", "pickle.loads", "pickle.Unpickler", "torch.load", "yaml.load", "marshal.load",
    "marshal.loads", "shelve.open", "joblib.load", "dill.load", "dill.loads", "runpy.run_path",
    "shutil.unpack_archive", "zipfile.ZipFile", "tarfile.open", "np.load", "numpy.load",
    "pd.read_pickle", "connection.load_extension", "connection.enable_load_extension",
}  # fmt: skip
FOREIGN_MODULES = {"marshal", "shelve", "dill", "joblib", "yaml", "zipfile", "tarfile", "xml"}


def foreign_calls(tree: ast.AST) -> Iterator[str]:
    """Yield the calls in a module that could run code from a file, unless an option prevents it."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        arguments = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        name = ast.unparse(node.func)
        harmless = (
            arguments.get("weights_only") == "True" or arguments.get("allow_pickle") == "False"
        )
        shell = arguments.get("shell", "False") != "False"
        if (name in RUNS_FOREIGN_CODE and not harmless) or shell:
            yield name
        if arguments.get("allow_pickle", "False") != "False":
            yield name


def test_no_code_from_a_file_is_run() -> None:
    """Processes of one run unpickle each other's bytes; the plain pickle reader runs nothing."""
    calls = {
        (str(path.relative_to(ROOT)), call)
        for path in MODULES
        for call in foreign_calls(ast.parse(path.read_text()))
    }
    assert calls == {
        ("pipelines/engine/executors/base.py", "pickle.loads"),
        ("pipelines/engine/ray_training.py", "pickle.loads"),
        ("curate/training/processes.py", "pickle.loads"),
        ("curate/files/child_process.py", "pickle.load"),
        ("curate/training/loading.py", "pickle.loads"),
        ("curate/review/editors/cvat.py", "zipfile.ZipFile"),
        ("curate/detectors/openpcdet/checkpoint.py", "zipfile.ZipFile"),
    }
    readers = {str(path.relative_to(ROOT)) for path in MODULES if "Unpickler" in path.read_text()}
    assert readers == {"curate/detectors/recorded/plain_pickle.py"}
    unexpected = {
        (path.name, name)
        for path in MODULES
        for name in imports(path)
        if name.split(".")[0] in FOREIGN_MODULES
    }
    # CVAT exports are archives; they are read in memory, with a limited size, never unpacked.
    # Checkpoints of torch are archives too; their checksums are compared, nothing is unpacked.
    # KITTI's tracklets are XML; entities, which can expand to gigabytes, are rejected.
    # OpenPCDet's model files are YAML; only `safe_load` is used, which builds plain values.
    assert unexpected == {
        ("cvat.py", "zipfile"), ("checkpoint.py", "zipfile"), ("tracklets.py", "xml.parsers"),
        ("schema.py", "yaml"),
    }  # fmt: skip


@pytest.mark.parametrize(
    "line",
    [
        "eval(text)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "yaml.load(text)",
        "subprocess.run(text, shell=True)",
        "read(path, allow_pickle=wish)",
    ],
)
def test_the_search_finds_every_kind_of_call(line: str) -> None:
    """Otherwise an empty result would prove nothing."""
    assert list(foreign_calls(ast.parse(line)))
    assert not list(foreign_calls(ast.parse("torch.load(path, weights_only=True); f.load(x)")))


def test_every_dependency_is_pinned() -> None:
    """The constraints file has a version for each package of pyproject.toml."""
    pinned = {
        line.split("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    made = ("test", "lint", "bench", "serve", "browser")  # the extras that `make` installs
    required = {
        requirement.split(">")[0].split(";")[0].split("[")[0].strip().lower()
        for requirement in (*project["dependencies"], *chain(*map(extras.get, made)))
    }
    assert required - {"open3d"} <= pinned
