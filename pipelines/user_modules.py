"""Modules of the user: also found in the current folder, never given curate's packages for theirs.

A project may have a package `db` of its own. In a process of curate `import db` means curate's, so
a module that expects the other one is rejected before it fails somewhere else.
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
    """Return a module of the user, imported.

    Raises:
        ConfigError: if it needs a package of the user with the name of one of curate's.
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
        wanted = _package_of(error)
        if wanted in shadowed:
            raise ConfigError(_conflict(name, wanted, shadowed[wanted])) from error
        raise
    # User code may well import `curate`: it is where `Detections` and the protocols are.
    unused = shadowed.keys() - {"curate"}
    if unused:
        for loaded in {name, *(set(sys.modules) - before)}:
            for wanted in _imported_packages(sys.modules[loaded]):
                if wanted in unused:
                    raise ConfigError(_conflict(loaded, wanted, shadowed[wanted]))
    return module


def _shadowed_packages() -> dict[str, Path]:
    """Return the packages of the user with the names of curate's, with the file of each."""
    elsewhere = [entry for entry in sys.path if Path(entry).resolve() != _HOME]
    found = {name: PathFinder.find_spec(name, elsewhere) for name in _PACKAGES}
    # A folder without __init__.py has no origin: Python prefers a package that has one.
    return {name: Path(spec.origin) for name, spec in found.items() if spec and spec.origin}


def _package_of(error: ImportError | AttributeError) -> str:
    """Return the package in which something was not found."""
    name = getattr(error.obj, "__name__", "") if isinstance(error, AttributeError) else error.name
    return (name or "").partition(".")[0]


def _imported_packages(module: ModuleType) -> Iterator[str]:
    """Yield the packages that a module outside curate's folders imports anywhere in its source."""
    file = Path(getattr(module, "__file__", None) or "")
    own = any(file.is_relative_to(_HOME / package) for package in _PACKAGES)
    if own or file.suffix != ".py" or not file.is_file():
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
        f"another name, or run the detector apart and use its result files"
    )
