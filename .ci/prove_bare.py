"""Prove that `make venv-tests`, the demo and the tests work in minimal Debian systems, made here.

Usage, as root, with debootstrap installed: prove_bare.py SUITE...

For each suite debootstrap makes a minimal system, to which only python3, python3-venv and make are
added. The commands of `STEPS` run there in a copy of the checkout. Mounts are made in a separate
namespace and end with it. The settings of pip on this machine are passed in
the environment; local folders and files that they name are mounted at the same place.

Environment: BARE_FOLDER (default: a temporary folder, removed at the end), BARE_MIRROR, BARE_TESTS.
"""

import ast
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from urllib.parse import urlsplit

ROOT = Path(__file__).resolve().parent.parent
MIRROR = os.environ.get("BARE_MIRROR", "http://deb.debian.org/debian")
TESTS = os.environ.get(
    "BARE_TESTS",
    "tests/test_house.py tests/curate/simulation/test_open3d_loader.py "
    "tests/curate/geometry tests/curate/priors tests/pipelines/test_cli.py",
)
HOME = "/srv/curate"
PYTEST = ".venv/bin/python -m pytest -q"
STEPS = (
    # Without root, one command lists everything that is missing, and nothing is downloaded.
    ("! su nobody -s /bin/sh -c 'python3 .ci/check_system.py'", "what is missing"),
    ("make venv-tests SIMULATION=no", "venv without simulation"),
    ("! .venv/bin/curate simulate /tmp/data --frames 8", "simulation reports what it needs"),
    (f"{PYTEST} tests/pipelines/test_without_open3d.py", "own data without simulation"),
    ("rm .venv/.ready* && make venv-tests", "venv"),
    (
        ".venv/bin/curate demo /tmp/demo --frames 16 --val 4 --labeled 0.25 --steps 20",
        "demo",
    ),
    (f"{PYTEST} {TESTS}", "tests"),
)


def main(suites: list[str]) -> int:
    """Return 0 if every step works in every suite."""
    if os.geteuid() != 0 or shutil.which("debootstrap") is None:
        sys.stderr.write("error: run as root, with debootstrap (apt-get install debootstrap)\n")
        return 1
    with tempfile.TemporaryDirectory(prefix="bare-", dir=os.environ.get("BARE_FOLDER")) as folder:
        proven = [prove(suite, Path(folder) / suite) for suite in suites]
    return 0 if all(proven) else 1


def prove(suite: str, system: Path) -> bool:
    """Return whether every step works in one suite; report each with its time."""
    include = "--include=python3,python3-venv,make"
    bootstrap = ["debootstrap", "--variant=minbase", include, suite, str(system), MIRROR]
    if not report(suite, "debootstrap", lambda: run(bootstrap, quiet=True)):
        return False
    copy_checkout(system / HOME.lstrip("/"))
    return all(
        report(suite, name, lambda command=command: run(within(system, command)))
        for command, name in STEPS
    )


def report(suite: str, name: str, work: Callable[[], int]) -> bool:
    """Do the work and print how it ended; return whether it worked."""
    start = time.monotonic()
    sys.stdout.write(f"== {suite}: {name}\n")
    sys.stdout.flush()
    status = work()
    result = "ok" if status == 0 else f"FAILED ({status})"
    sys.stdout.write(f"== {suite}: {name}: {result}, {time.monotonic() - start:.0f} s\n")
    sys.stdout.flush()
    return status == 0


def copy_checkout(home: Path) -> None:
    """Copy the files that git knows or would add."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.check_output(listed, cwd=ROOT, text=True).split("\0"):
        if (ROOT / name).is_file():
            (home / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, home / name)


def within(system: Path, command: str) -> list[str]:
    """Return the command line that runs a shell command in the checkout within the system."""
    settings = dict(pip_settings())
    mounts = [f"mount -t proc proc {system}/proc", f"mount --rbind /dev {system}/dev"]
    for path in local_paths(settings.values()):
        place = system / path.relative_to("/")
        mkdir = f"mkdir -p {place}" if path.is_dir() else f"mkdir -p {place.parent}; touch {place}"
        mounts.append(f"{mkdir}; mount --bind -o ro {path} {place}")
    environment = {
        "HOME": "/root",
        "PATH": "/usr/sbin:/usr/bin:/sbin:/bin",
        "LANG": "C.UTF-8",
        "PIP_NO_CACHE_DIR": "1",
        "PIP_ROOT_USER_ACTION": "ignore",
        **{name: value for name, value in os.environ.items() if name.endswith("_proxy")},
        **settings,
    }
    inside = [
        *("chroot", str(system), "env", "-i"),
        *(f"{name}={value}" for name, value in environment.items()),
        *("sh", "-c", f"cd {HOME} && {command}"),
    ]
    script = "; ".join(["set -e", "mount --make-rprivate /", *mounts, shlex.join(inside)])
    return ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", script]


def pip_settings() -> Iterator[tuple[str, str]]:
    """Yield the settings of pip on this machine as environment variables."""
    listed = subprocess.check_output([sys.executable, "-m", "pip", "config", "list"], text=True)
    for line in listed.splitlines():
        key, _, value = line.partition("=")
        name = key.rpartition(".")[2]
        if name != "config-file":
            yield f"PIP_{name.upper().replace('-', '_')}", ast.literal_eval(value)


def local_paths(values: Iterable[str]) -> list[Path]:
    """Return the local folders and files that settings name; of an index, the folder around it."""
    found = []
    for word in " ".join(values).split():
        parts = urlsplit(word)
        path = Path(parts.path).parent if parts.scheme == "file" else Path(word)
        if path.is_absolute() and path.exists():
            found.append(path)
    return sorted(set(found))


def run(command: list[str], *, quiet: bool = False) -> int:
    """Run a command; return its exit status. A quiet one prints only when it fails."""
    if not quiet:
        return subprocess.run(command, stdin=subprocess.DEVNULL, check=False).returncode
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode:
        sys.stderr.write(ended.stdout + ended.stderr)
    return ended.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
