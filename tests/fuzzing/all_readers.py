"""Random fuzzing of every reader: python -m fuzzing.all_readers SECONDS FOLDER, or `make fuzz-all`.

Each reader gets a share of the time and a process of its own, which reads damaged copies of its
valid file. Findings are: an exception other than a `CurateError` of one line, a numerical warning,
more than `LIMIT_KIB` of memory for one file, the end of the process, and a file that takes longer
than `LIMIT_S`. The log has a line per reader; FOLDER gets the first file of each finding. The exit
code is 1 if there are findings.
"""

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from contextlib import suppress
from pathlib import Path

from fuzzing.mutations import mutated
from fuzzing.targets import TARGETS
from support.paths import ROOT, TESTS
from support.process_tree import forget_peak, peak

LIMIT_KIB, LIMIT_S = 300 << 10, 60.0
# Libraries in C++ read these formats, so they get three times the time of others.
NATIVE = ("png", "jpg", "map", "parquet", "feather", "onnx", "checkpoint", "nuscenes results")
READ, REJECTED, FINDING = b".", b"-", b"!"


def main(arguments: list[str]) -> int:
    """Fuzz the selected readers one after the other and print the log."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--reader", action="append", choices=sorted(TARGETS))
    given = parser.parse_args(arguments)
    names = given.reader or list(TARGETS)
    shares = {name: 3 if any(word in name for word in NATIVE) else 1 for name in names}
    given.folder.mkdir(parents=True, exist_ok=True)
    _print(f"seed {given.seed}, {given.seconds:.0f} s in all")
    _print(f"{'reader':28}{'files':>9}{'rejected':>10}{'seconds':>9}{'findings':>10}")
    runs = []
    for name in names:
        run = Fuzzing(name, given.folder)
        run.last(given.seconds * shares[name] / sum(shares.values()), given.seed)
        runs.append(run)
        _print(f"{name:28}{run.files:9}{run.rejected:10}{run.seconds:9.0f}{run.count:10}")
        for finding, times in run.findings.items():
            _print(f"    {times} x {finding}")
    sums = [sum(getattr(run, key) for run in runs) for key in ("files", "rejected", "count")]
    seconds = sum(run.seconds for run in runs)
    _print(f"{f'{len(runs)} readers':28}{sums[0]:9}{sums[1]:10}{seconds:9.0f}{sums[2]:10}")
    return 1 if sums[2] else 0


def _print(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


class Fuzzing:
    """The damaged files of one reader.

    Attributes:
        files: number of files that were tried.
        rejected: number of those that were rejected with an error message.
        seconds: time taken.
        findings: number of files with each finding.
    """

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self._folder = name, folder
        self.files = self.rejected = 0
        self.seconds = 0.0
        self.findings: dict[str, int] = {}

    @property
    def count(self) -> int:
        """Number of different findings."""
        return len(self.findings)

    def last(self, seconds: float, seed: int) -> None:
        """Try files for that long; a process that ends by itself is recorded and replaced."""
        begin = time.monotonic()
        while time.monotonic() < begin + seconds:
            with tempfile.TemporaryDirectory() as home:
                self._run_process(Path(home), begin + seconds, seed)
            seed += 1_000_003
        self.seconds = time.monotonic() - begin

    def _run_process(self, home: Path, end: float, seed: int) -> None:
        command = [sys.executable, "-m", "fuzzing.all_readers", "--one", self.name, seed, home]
        own = {"PYTHONPATH": f"{TESTS}:{ROOT}", "XDG_CACHE_HOME": str(home / "cache")}
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        with (home / "marks").open("wb") as marks, (home / "errors").open("wb") as errors:
            process = subprocess.Popen(
                list(map(str, command)),
                stdout=marks,
                stderr=errors,
                cwd=TESTS,
                env=os.environ | own | threads,
            )
            problem = _problem(process, home / "damaged" / TARGETS[self.name].name, end)
        tried = (home / "marks").read_bytes()
        self.files += len(tried)
        self.rejected += tried.count(REJECTED)
        for note in sorted(home.glob("*.finding")):
            self._keep(note.read_text(), note.with_suffix("").read_bytes())
        if problem is not None:
            said = (home / "errors").read_text(errors="replace").strip().splitlines()[-1:]
            content = (home / "damaged" / TARGETS[self.name].name).read_bytes()
            self._keep(": ".join([problem, *said])[:300], content)

    def _keep(self, finding: str, content: bytes) -> None:
        if finding not in self.findings:
            name = f"{self.name} {self.count} {Path(TARGETS[self.name].name).name}"
            (self._folder / name.replace(" ", "-")).write_bytes(content)
        self.findings[finding] = self.findings.get(finding, 0) + 1


def _problem(process: subprocess.Popen, damaged: Path, end: float) -> str | None:
    """Return how a process ended by itself, or that it hangs; None once the time is over."""
    while time.monotonic() < end:
        with suppress(subprocess.TimeoutExpired):
            return f"the process ended with code {process.wait(0.5)}"
        with suppress(FileNotFoundError):  # the first file is not written yet
            if time.time() - damaged.stat().st_mtime > LIMIT_S:
                process.kill()
                process.wait()
                return f"reading takes more than {LIMIT_S:.0f} s"
    process.kill()
    process.wait()
    return None


def try_files(name: str, seed: int, home: Path) -> None:
    """Read damaged files until the parent process ends this one."""
    target = TARGETS[name]
    path = home / "damaged" / target.name
    path.parent.parent.mkdir(parents=True, exist_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    target.write(path)
    valid = path.read_bytes()
    target.attempt(path)  # loads its libraries
    warnings.simplefilter("error", RuntimeWarning)
    findings: set[str] = set()
    while True:
        content = mutated(valid, random.Random(seed).randint)  # noqa: S311
        path.write_bytes(content)
        forget_peak()
        before = peak()
        try:
            mark = READ if target.attempt(path) is None else REJECTED
            grown = peak() - before
            finding = f"takes {grown >> 10} MiB" if grown > LIMIT_KIB else None
        except Exception as error:  # noqa: BLE001 - every other error is a finding
            mark, finding = FINDING, _described(error)
        if finding is not None and finding not in findings:
            findings.add(finding)
            (home / f"{len(findings)}").write_bytes(content)
            (home / f"{len(findings)}.finding").write_text(finding)
        os.write(1, mark)
        seed += 1


def _described(error: Exception) -> str:
    """Return type, message and place of an error."""
    frames = [
        frame
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename.startswith(str(ROOT)) and "/.venv/" not in frame.filename
    ]
    place = f"{Path(frames[-1].filename).relative_to(ROOT)}:{frames[-1].lineno}" if frames else ""
    message = " ".join(str(error).split())[:80]
    return f"{type(error).__name__} in {place}: {message}"


if __name__ == "__main__":
    if sys.argv[1] == "--one":
        try_files(sys.argv[2], int(sys.argv[3]), Path(sys.argv[4]))
    sys.exit(main(sys.argv[1:]))
