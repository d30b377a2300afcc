"""The house: who may import whom, and what may be said in it."""

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
# The rooms of each package, from the ground up: a room imports only rooms before it.
LAYERS = {
    "curate": (
        "shapes", "errors", "spelling", "files", "frames", "geometry", "detections", "consistency",
        "datasets", "simulation", "segmenters", "priors", "weighting", "evaluation", "exporters",
        "detectors", "firewall", "viewing", "review", "training", "__main__",
    ),
    "pipelines": (
        "user_modules", "registry", "workspace", "assembly", "engine", "labels", "firewall",
        "review", "stages", "round", "assessment", "queries", "reports", "serving", "bench", "demo",
        "commands", "cli", "__main__",
    ),
}  # fmt: skip
HOUSE = sorted(path for folder in MAY_IMPORT for path in (ROOT / folder).rglob("*.py"))


def imports(path: Path) -> Iterator[str]:
    """The modules that a file imports, anywhere in it."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""


@pytest.mark.parametrize("path", HOUSE, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path: Path) -> None:
    """A module imports only from its own folder and those below it."""
    folder = path.relative_to(ROOT).parts[0]
    own = {name.split(".")[0] for name in imports(path)} & set(MAY_IMPORT)
    assert own <= MAY_IMPORT[folder]


def module_name(path: Path) -> str:
    """The dotted name of a file's module."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def import_graph() -> dict[str, set[str]]:
    """The modules of the house that each module imports, deferred imports included."""
    modules = {module_name(path): path for path in HOUSE}
    graph: dict[str, set[str]] = {name: set() for name in modules}
    for name, path in modules.items():
        for node in ast.walk(ast.parse(path.read_text())):
            found = []
            if isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                # What is imported from a package may be one of its modules.
                inner = [f"{node.module}.{alias.name}" for alias in node.names]
                found = [each if each in modules else node.module for each in inner]
            graph[name] |= {each for each in found if each in modules and each != name}
    return graph


def test_no_module_imports_itself_through_others() -> None:
    """There is not a circle, imports inside functions included."""
    try:
        TopologicalSorter(import_graph()).prepare()
    except CycleError as circle:
        pytest.fail(" -> ".join(circle.args[1]))


def test_rooms_import_only_rooms_below_them() -> None:
    """Every room has its place in the layers, and no arrow points upwards."""
    upward = []
    for name, imported in import_graph().items():
        for other in imported:
            package, room, other_room = name.split(".")[0], room_of(name), room_of(other)
            if package != other.split(".")[0] or package not in LAYERS or room == other_room:
                continue
            # The package itself gathers the public names, so it stands above all of its rooms.
            layers = (*LAYERS[package], "")
            if layers.index(other_room) > layers.index(room):
                upward.append(f"{name} -> {other}")
    assert upward == []


def room_of(module: str) -> str:
    """The folder or file of a module within its package; "" for the package itself."""
    return module.partition(".")[2].partition(".")[0]


def test_only_the_planned_rooms_stand_in_the_house() -> None:
    """A new file or folder at the top of a package needs a place in the layers."""
    for package, layers in LAYERS.items():
        own = [path for path in HOUSE if path.relative_to(ROOT).parts[0] == package]
        assert {room_of(module_name(path)) for path in own} - {""} == set(layers)


def test_curate_stands_alone() -> None:
    """`curate` imports where db and pipelines do not exist, so a user's own db.py does no harm."""
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in HOUSE
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


def test_only_the_label_file_format_speaks_sql_in_curate() -> None:
    """The science knows no database."""
    users = {
        str(path.relative_to(ROOT))
        for path in HOUSE
        if {"sqlite3", "sqlalchemy"} & {name.split(".")[0] for name in imports(path)}
        and path.relative_to(ROOT).parts[0] == "curate"
    }
    assert users <= {
        "curate/exporters/label_file.py",
        "curate/exporters/sqlite.py",
        "curate/training/labels.py",
    }


def test_every_module_says_what_it_is_for() -> None:
    """A docstring of one sentence first."""
    silent = [str(path) for path in HOUSE if not ast.get_docstring(ast.parse(path.read_text()))]
    assert silent == []


# What runs code that a file names, unpacks archives, or lets a shell read a text.
RUNS_FOREIGN_CODE = {
    "eval", "exec", "compile", "__import__", "os.system", "os.popen",
    "pickle.load", "pickle.loads", "pickle.Unpickler", "torch.load", "yaml.load", "marshal.load",
    "marshal.loads", "shelve.open", "joblib.load", "dill.load", "dill.loads", "runpy.run_path",
    "shutil.unpack_archive", "zipfile.ZipFile", "tarfile.open", "np.load", "numpy.load",
    "pd.read_pickle", "connection.load_extension", "connection.enable_load_extension",
}  # fmt: skip
FOREIGN_MODULES = {"marshal", "shelve", "dill", "joblib", "yaml", "zipfile", "tarfile", "xml"}


def foreign_calls(tree: ast.AST) -> Iterator[str]:
    """The calls in a module that could run what a file says, unless told not to."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        said = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        name = ast.unparse(node.func)
        harmless = said.get("weights_only") == "True" or said.get("allow_pickle") == "False"
        shell = said.get("shell", "False") != "False"
        if (name in RUNS_FOREIGN_CODE and not harmless) or shell:
            yield name
        if said.get("allow_pickle", "False") != "False":
            yield name


def test_nothing_runs_what_a_file_says() -> None:
    """The process executor reads its parent's bytes; a foreign pickle's reader runs nothing."""
    calls = {
        (str(path.relative_to(ROOT)), call)
        for path in HOUSE
        for call in foreign_calls(ast.parse(path.read_text()))
    }
    assert calls == {
        ("pipelines/engine/executors/base.py", "pickle.loads"),
        ("curate/review/editors/cvat.py", "zipfile.ZipFile"),
    }
    readers = {str(path.relative_to(ROOT)) for path in HOUSE if "Unpickler" in path.read_text()}
    assert readers == {"curate/detectors/recorded/plain_pickle.py"}
    strangers = {
        (path.name, name)
        for path in HOUSE
        for name in imports(path)
        if name.split(".")[0] in FOREIGN_MODULES
    }
    # CVAT's answers are archives; they are read in memory, of a bounded size, never unpacked.
    assert strangers == {("cvat.py", "zipfile")}


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
def test_the_search_finds_what_it_is_for(line: str) -> None:
    """Or it would say nothing."""
    assert list(foreign_calls(ast.parse(line)))
    assert not list(foreign_calls(ast.parse("torch.load(path, weights_only=True); f.load(x)")))


def test_every_dependency_is_pinned() -> None:
    """The constraints file names a version for each package of the card."""
    pinned = {
        line.split("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    }
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    made = ("test", "lint", "bench", "serve", "browser")  # the extras that `make` installs
    wanted = {
        requirement.split(">")[0].split(";")[0].split("[")[0].strip().lower()
        for requirement in (*project["dependencies"], *chain(*map(extras.get, made)))
    }
    assert wanted - {"open3d"} <= pinned
