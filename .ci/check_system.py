"""Check what curate needs of the system, before anything is downloaded.

Python, its venv module, and the libraries of open3d, which only simulation needs. As root on Debian
or Ubuntu, missing packages are installed; otherwise one command lists all of them. Only the
standard library is used, and the syntax of old Pythons, so that each of them can print its line.

Usage: check_system.py [--without-simulation]
"""

import importlib.util
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

OLDEST = (3, 11)
ROOT = Path(__file__).resolve().parent.parent
LIBRARIES = ROOT / "curate" / "simulation" / "system_libraries.py"


def main(arguments: "list[str]") -> int:
    """Return the exit status: 0 if nothing is missing any more."""
    if sys.version_info < OLDEST:
        return fail(
            f"curate needs Python {OLDEST[0]}.{OLDEST[1]} or newer; {sys.executable} is "
            f"{sys.version.split()[0]}. Name a newer one: make PYTHON=python3.12 venv"
        )
    packages = []
    if importlib.util.find_spec("ensurepip") is None or importlib.util.find_spec("venv") is None:
        packages.append(f"python{sys.version_info[0]}.{sys.version_info[1]}-venv")
    libraries = []
    if "--without-simulation" not in arguments:
        table = runpy.run_path(str(LIBRARIES))
        libraries = table["missing_libraries"]()
        packages += [table["DEBIAN_PACKAGES"][name] for name in libraries]
    if not packages:
        return 0
    if shutil.which("apt-get") is None:
        names = ", ".join(["Python's venv module"][: len(packages) - len(libraries)] + libraries)
        return fail(f"This system lacks {names}. Install them{hint(libraries)}.")
    if os.geteuid() != 0:
        command = f"sudo apt-get update && sudo apt-get install -y {' '.join(packages)}"
        return fail(f"This system lacks some packages. Run: {command}{hint(libraries)}")
    return install(packages)


def hint(libraries: "list[str]") -> str:
    """Return how to go on without the libraries, where only they are missing."""
    return "\nor go on without simulation and demo: make venv SIMULATION=no" if libraries else ""


def install(packages: "list[str]") -> int:
    """Install packages with apt-get, quietly; return the exit status."""
    say(f"Installing with apt-get: {' '.join(packages)}")
    environment = dict(os.environ, DEBIAN_FRONTEND="noninteractive")
    for command in (
        ["apt-get", "update", "-qq"],
        ["apt-get", "install", "-y", "-qq", "--no-install-recommends", *packages],
    ):
        ended = subprocess.run(
            command,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if ended.returncode:
            return fail(f"{ended.stdout.strip()}\n`{' '.join(command)}` failed")
    return 0


def fail(message: str) -> int:
    """Print an error; return the exit status that goes with it."""
    say(f"error: {message}")
    return 1


def say(message: str) -> None:
    """Print a message where it does not mix with output."""
    sys.stderr.write(f"{message}\n")
    sys.stderr.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
