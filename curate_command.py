"""The entry point of the command `curate`, which imports curate's own packages first.

`curate`, `db` and `pipelines` are common names. The user's project may have packages with the same
names, and Python searches the current folder and PYTHONPATH before the folder in which curate is
installed. The name of this module is unlikely to be taken. On import, it loads the three packages
from the folder that it is in. Later imports of their submodules come from there too, and
`sys.path` stays as the user has set it. Worker processes import this module before they unpickle
their work: multiprocessing imports the main module of its parent, and Ray calls `claim_packages`.
"""

import atexit
import gc
import importlib
import sys
from pathlib import Path

HOME = Path(__file__).resolve().parent
PACKAGES = ("curate", "db", "pipelines")
COLLECTION_THRESHOLD = 10_000  # new objects between two garbage collections; Python's own is 700


def claim_packages() -> None:
    """Import curate's own packages, even if other packages on the path have the same names."""
    sys.path.insert(0, str(HOME))
    try:
        for name in PACKAGES:
            file = Path(importlib.import_module(name).__file__ or "").resolve()
            if file.parents[1:2] != (HOME,):
                sys.exit(
                    f"error: the package '{name}' in {file.parent} was imported instead of "
                    f"curate's own ({HOME / name}); start curate with the command `curate`"
                )
    finally:
        sys.path.remove(str(HOME))


def main() -> None:
    """Run the command line."""
    # Imports make many objects that last as long as the process. To look for garbage among them,
    # again and again and once more at the end, takes a fifth of the time of a short command.
    gc.set_threshold(COLLECTION_THRESHOLD)
    atexit.register(gc.freeze)

    from pipelines import cli

    cli.main()


claim_packages()
if __name__ == "__main__":
    main()
