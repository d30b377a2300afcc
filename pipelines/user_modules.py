"""Import of the user's modules, also from the current folder.

A user's project may have a package `db` too. In a process of curate, `import db` always imports
curate's package. A user's module that expects the other one is rejected here, before it fails later
with an error that is hard to understand.
"""

import ast
import importlib
import sys
from collections.abc import Iterator
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType

from curate.errors import ConfigError

_HOME = Path(__file__).resolve().parents[1]
_PACKAGES = ("curate", "db", "pipelines")


def import_user_module(name: str) -> ModuleType:
    """Import a module of the user, and return it.

    Raises:
        ConfigError: if it needs a package of the user that has the name of a package of curate.
        ImportError: if it cannot be imported for another reason.
    """
    folder = str(Path.cwd())
    if folder not in sys.path and "" not in sys.path:
        sys.path.append(folder)
    shadowed = _shadowed_packages()
    before = set(sys.modules)
    try:
        module = importlib.import_module(name)
    except (ImportError, AttributeError) as error:
        package = _package_of(error)
        if package in shadowed:
            raise ConfigError(_conflict(name, package, shadowed[package])) from error
        raise
    # User code may import `curate` itself, for `Detections` and the protocols.
    unused = shadowed.keys() - {"curate"}
    if unused:
        for loaded in {name, *(set(sys.modules) - before)}:
            for package in _imported_packages(sys.modules[loaded]):
                if package in unused:
                    raise ConfigError(_conflict(loaded, package, shadowed[package]))
    return module


def _shadowed_packages() -> dict[str, Path]:
    """Return the files of the user's packages that have the name of a package of curate."""
    elsewhere = [entry for entry in sys.path if Path(entry).resolve() != _HOME]
    found = {name: PathFinder.find_spec(name, elsewhere) for name in _PACKAGES}
    # A folder without __init__.py has no origin. It does not matter: Python prefers a package with
    # __init__.py, which is curate's.
    return {name: Path(spec.origin) for name, spec in found.items() if spec and spec.origin}


def _package_of(error: ImportError | AttributeError) -> str:
    """Return the top-level package in which the import did not find a name."""
    name = getattr(error.obj, "__name__", "") if isinstance(error, AttributeError) else error.name
    return (name or "").partition(".")[0]


def _imported_packages(module: ModuleType) -> Iterator[str]:
    """Yield the top-level packages imported anywhere in the source of a module of the user.

    For a module of curate nothing is yielded.
    """
    file = Path(getattr(module, "__file__", None) or "")
    ours = any(file.is_relative_to(_HOME / package) for package in _PACKAGES)
    if ours or file.suffix != ".py" or not file.is_file():
        return
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield (node.module or "").partition(".")[0]


def _conflict(module: str, package: str, theirs: Path) -> str:
    return (
        f"module '{module}' imports '{package}', which inside curate is curate's own package "
        f"({_HOME / package}), not yours ({theirs}): rename yours, move it into a package with "
        f"another name, or run the detector separately and use its result files"
    )
