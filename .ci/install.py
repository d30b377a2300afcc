"""Install curate or some of its extras into the virtual environment, with a line of progress.

pip prints several hundred lines, and then nothing for half a minute while it installs. This shows
one line instead: what happens now, and how long it will take. All of pip's output is in
`.venv/install.log`; its end is printed if it fails.

Usage: install.py MEGABYTES REQUIREMENT [--otherwise TEXT]

MEGABYTES is the expected size on disk, from which the time that is left is estimated. With
--otherwise a failure prints the text and counts as success.
"""

import argparse
import compileall
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import TextIO

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = Path(next(path for path in sys.path if path.endswith("site-packages")))
LOG = Path(sys.prefix) / "install.log"
LINES_WHEN_FAILED = 25
# Files to download are about a third of what they become on disk.
PACKED = 0.35
# Seconds between two lines where the line cannot be overwritten, as in a log.
LOG_EVERY_S = 15.0


class Progress:
    """The state of an installation, shown in one line.

    Args:
        megabytes: expected size on disk.
    """

    def __init__(self, megabytes: float) -> None:
        self._megabytes = megabytes
        self._start = self._shown = time.monotonic()
        self._free, self._before = free_megabytes(), installed_megabytes()
        self._fetched = 0.0
        self._what = "looking up packages"

    def read(self, line: str) -> None:
        """Take a line of pip's output."""
        if found := re.match(r"(?:Collecting|Processing) (\S+)", line):
            self._what = f"fetching {package_name(found[1])}"
            local = Path(found[1])
            self._fetched += local.stat().st_size / 1e6 if local.is_file() else 0.0
        elif found := re.search(r"\(([\d.]+) (kB|MB|GB)\)", line):
            self._fetched += float(found[1]) * {"kB": 1e-3, "MB": 1.0, "GB": 1e3}[found[2]]
        elif line.startswith("Installing collected packages:"):
            self._what = f"installing {line.count(',') + 1} packages"

    def show(self) -> None:
        """Print the line: over the former one in a terminal, else every 15 seconds."""
        now = time.monotonic()
        if not sys.stdout.isatty() and now - self._shown < LOG_EVERY_S:
            return
        self._shown = now
        written = min(max(self._free - free_megabytes(), 0.0), self._megabytes)
        share = (self._fetched / PACKED + written) / (2 * self._megabytes)
        seconds = now - self._start
        line = f"  {self._what}, {written:,.0f} of about {self._megabytes:,.0f} MB, {seconds:.0f} s"
        if 0.1 < share < 1:
            line += f", about {seconds / share - seconds:.0f} s left"
        self._print(line)

    def end(self, line: str) -> None:
        """Print the last line."""
        self._print(line)
        if sys.stdout.isatty():
            print(flush=True)

    def summary(self) -> str:
        """Return what was installed, and in which time."""
        seconds = time.monotonic() - self._start
        return f"  {installed_megabytes() - self._before:,.0f} MB in {seconds:.0f} s"

    def _print(self, line: str) -> None:
        if sys.stdout.isatty():
            print(f"\r{line[:79]:<79}", end="", flush=True)
        else:
            print(line, flush=True)


def package_name(text: str) -> str:
    """Return the name of a package in a requirement, or in the path of a file."""
    name = re.split(r"[^\w.-]|[-.]\d", Path(text).name, maxsplit=1)[0]
    return name or text


def free_megabytes() -> float:
    """Return the free space of the disk; its change shows how much was written.

    This takes no time; `installed_megabytes` looks at every file.
    """
    return shutil.disk_usage(PACKAGES).free / 1e6


def installed_megabytes() -> float:
    """Return the size of the environment's packages."""
    size = 0
    for path in PACKAGES.rglob("*"):
        try:
            size += path.lstat().st_size
        except OSError:  # pip has just moved it
            continue
    return size / 1e6


def run_pip(requirement: str, progress: Progress, log: TextIO) -> int:
    """Run pip and show its progress; return its exit status."""
    command = [sys.executable, "-m", "pip", "install", "--progress-bar", "off", "--no-compile"]
    command += ["--disable-pip-version-check", "-c", str(ROOT / "constraints.txt")]
    command += ["-e", requirement] if requirement.startswith(".") else [requirement]
    log.write(" ".join(command) + "\n")
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        ended = threading.Event()

        def tick() -> None:
            while not ended.wait(1.0):
                progress.show()

        ticking = threading.Thread(target=tick)
        ticking.start()
        for line in process.stdout or ():
            log.write(line)
            progress.read(line.strip())
        # pip compiles on one core, this on all of them. Some packages contain templates that are
        # not valid Python; they stay as they are.
        if process.wait() == 0:
            compileall.compile_dir(PACKAGES, quiet=2, workers=0)
        ended.set()
        ticking.join()
        return process.returncode


def main(arguments: "list[str]") -> int:
    """Return the exit status of pip."""
    parser = argparse.ArgumentParser()
    parser.add_argument("megabytes", type=float)
    parser.add_argument("requirement")
    parser.add_argument("--otherwise")
    given = parser.parse_args(arguments)
    progress = Progress(given.megabytes)
    with LOG.open("a", encoding="utf-8") as log:
        status = run_pip(given.requirement, progress, log)
    if status and given.otherwise:
        progress.end(f"  {given.otherwise}")
        return 0
    if status:
        progress.end("  pip failed:")
        lines = LOG.read_text(encoding="utf-8", errors="replace").splitlines()
        print("\n".join(lines[-LINES_WHEN_FAILED:]))
        print(f"error: the packages cannot be installed; the whole output of pip is in {LOG}")
    else:
        progress.end(progress.summary())
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
