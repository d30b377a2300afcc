"""Real failures of the machine: each gives a one-line error, and nothing is lost."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from support.pipelines_cli import Curate
from support.process_tree import environment, start, workers
from support.rounds import run_workspace
from support.stored_rows import dump

from curate.errors import CurateError, DatabaseError
from db import session
from pipelines.workspace.setup import initialise
from pipelines.workspace.workspace import Workspace

LOCK = """
import sqlite3, sys, time
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN IMMEDIATE")
print("locked", flush=True)
time.sleep(float(sys.argv[2]))
"""
# A clock set back by ten years, for every caller of the C library.
CLOCK = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/time.h>
#include <time.h>
#define BACK (10L * 365 * 86400)
int clock_gettime(clockid_t id, struct timespec *now) {
    int (*real)(clockid_t, struct timespec *) = dlsym(RTLD_NEXT, "clock_gettime");
    int code = real(id, now);
    if (id == CLOCK_REALTIME) now->tv_sec -= BACK;
    return code;
}
int gettimeofday(struct timeval *now, void *zone) {
    struct timespec time;
    int code = clock_gettime(CLOCK_REALTIME, &time);
    now->tv_sec = time.tv_sec; now->tv_usec = time.tv_nsec / 1000;
    return code;
}
time_t time(time_t *out) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (out) *out = now.tv_sec;
    return now.tv_sec;
}
"""


@pytest.fixture
def whole(tmp_path: Path, workspace: Workspace) -> list[tuple]:
    """Return what an undisturbed run stores."""
    other = initialise(tmp_path / "whole", workspace.config, "0.25", "")
    run_workspace(other)
    return dump(other)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a disk of four megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    if shutil.which("mount") is None or not _mount("-t", "tmpfs", "-o", "size=4m", "tmpfs", folder):
        pytest.skip("a disk of our own needs the right to mount a tmpfs")
    yield folder
    subprocess.run(["umount", "--lazy", folder], check=True)


def _mount(*arguments: object) -> bool:
    return not subprocess.run(
        ["mount", *map(str, arguments)], check=False, capture_output=True
    ).returncode


def require_one_line(code: int, err: str, *codes: int) -> None:
    """Check that the error is one line without a traceback and has the exit code of its class."""
    assert code in codes, err
    assert err.count("\n") == 1, err
    assert err.startswith("error: ")


@pytest.mark.parametrize("free_kb", [0, 16, 64, 160])
def test_a_run_continues_after_a_full_disk(
    curate: Curate, workspace: Workspace, whole: list[tuple], small_disk: Path, free_kb: int
) -> None:
    """It fills up during the run.

    With space again the run ends as if it had not been interrupted.
    """
    tight = initialise(small_disk / "work", workspace.config, "0.25", "")
    tight.database.close()
    ballast = small_disk / "ballast"
    free = os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_bsize
    ballast.write_bytes(b"\0" * max(0, free - free_kb * 1024))
    code, _, err = curate("run", "-w", tight.root)
    require_one_line(code, err, CurateError.exit_code, DatabaseError.exit_code, 3)
    assert "space" in err or "full" in err
    ballast.unlink()
    assert curate("run", "-w", tight.root)[0] == 0
    assert dump(tight) == whole


def test_a_read_only_workspace_is_reported(
    curate: Curate, workspace: Workspace, small_disk: Path
) -> None:
    """Commands that only read still work if SQLite can read the file."""
    fixed = initialise(small_disk / "work", workspace.config, "0.25", "")
    fixed.database.close()
    assert _mount("-o", "remount,ro", small_disk)
    assert curate("status", "-w", fixed.root)[0] == 0
    for command in ("predict", "run"):
        code, _, err = curate(command, "-w", fixed.root)
        require_one_line(code, err, DatabaseError.exit_code)
        assert "curate.db" in err
        assert "writ" in err
    assert _mount("-o", "remount,rw", small_disk)
    assert curate("run", "-w", fixed.root)[0] == 0


@pytest.mark.parametrize("seed", range(4))
def test_a_corrupted_database_is_detected(curate: Curate, workspace: Workspace, seed: int) -> None:
    """Whatever pages are overwritten, a command works or gives one line with the fix.

    Never a traceback.
    """
    run_workspace(workspace)
    _checkpoint(workspace)
    path = workspace.root / "curate.db"
    pages = bytearray(path.read_bytes())
    generator = np.random.default_rng(seed)
    for page in generator.choice(len(pages) // 4096 - 1, 20, replace=False) + 1:
        pages[page * 4096 : page * 4096 + 200] = generator.bytes(200)
    path.write_bytes(pages)
    codes = set()
    for command in (("run",), ("status",), ("solve", "--policy", "uniform"), ("export",)):
        code, _, err = curate(*command, "-w", workspace.root)
        if code:
            require_one_line(code, err, DatabaseError.exit_code)
            assert "curate.db" in err
            assert "restore" in err
        codes.add(code)
    assert DatabaseError.exit_code in codes


def _checkpoint(workspace: Workspace) -> None:
    """Move all data from the journal to the database file."""
    with workspace.database.engine.connect() as connection:
        connection.exec_driver_sql("COMMIT")
        connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
    workspace.database.close()


@pytest.mark.skipif(not Path("/proc/locks").exists(), reason="the system does not tell who locks")
def test_the_error_of_a_locked_database_contains_the_owner(
    curate: Curate, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With process id and command line; when the owner ends, the command works."""
    monkeypatch.setattr(session, "BUSY_TIMEOUT_MS", 300)
    with _lock(workspace, 600) as holder:
        code, _, err = curate("predict", "-w", workspace.root)
        require_one_line(code, err, DatabaseError.exit_code)
        assert f"process {holder.pid} ({sys.executable} -c" in err
    assert curate("predict", "-w", workspace.root)[0] == 0


def test_a_command_waits_for_a_locked_database(curate: Curate, workspace: Workspace) -> None:
    """A lock that is released within half a minute is not an error."""
    with _lock(workspace, 1) as holder:
        assert curate("predict", "-w", workspace.root)[0] == 0
        assert holder.wait() == 0


@contextmanager
def _lock(workspace: Workspace, seconds: float) -> Iterator[subprocess.Popen]:
    arguments = [sys.executable, "-c", LOCK, workspace.root / "curate.db", str(seconds)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == b"locked\n"
            yield holder
        finally:
            holder.kill()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="workers are found in /proc")
def test_workers_killed_by_the_kernel_are_replaced(
    workspace: Workspace, whole: list[tuple]
) -> None:
    """SIGKILL for one worker after the other; the command succeeds with every frame."""
    running = start("run", "-w", workspace.root, "--workers", 2, TOY_DELAY_S="0.3")
    killed: set[int] = set()
    while running.poll() is None and len(killed) < 3:
        fresh = [pid for pid in workers(running.pid) if pid not in killed]
        if fresh and any(row[0] == "task" for row in dump(workspace)):  # work has started
            os.kill(fresh[0], 9)
            killed.add(fresh[0])
        time.sleep(0.2)
    _, err = running.communicate()
    assert running.returncode == 0, err
    assert "failed" not in err
    assert killed
    assert dump(workspace) == whole


def test_a_clock_that_was_set_back_changes_nothing(
    workspace: Workspace, whole: list[tuple], tmp_path: Path
) -> None:
    """Half of the work now, the other half ten years earlier."""
    if shutil.which("cc") is None:
        pytest.skip("another clock needs a C compiler")
    (tmp_path / "clock.c").write_text(CLOCK)
    library = tmp_path / "clock.so"
    flags = ["-shared", "-fPIC", "-o", str(library), str(tmp_path / "clock.c"), "-ldl"]
    subprocess.run(["cc", *flags], check=True)
    shifted = environment(LD_PRELOAD=str(library))
    code = "import time; print(time.gmtime().tm_year)"
    year = subprocess.run(
        [sys.executable, "-c", code], env=shifted, check=True, capture_output=True
    ).stdout
    assert int(year) < time.gmtime().tm_year - 8
    for command, more in (("predict", {}), ("run", {"LD_PRELOAD": str(library)})):
        running = start(command, "-w", workspace.root, **more)
        _, err = running.communicate()
        assert running.returncode == 0, err
    assert dump(workspace) == whole


def test_a_moved_workspace_resumes(
    curate: Curate, workspace: Workspace, whole: list[tuple], tmp_path: Path
) -> None:
    """Finished work is not repeated."""
    assert curate("predict", "-w", workspace.root)[0] == 0
    workspace.database.close()
    moved = tmp_path / "elsewhere" / "it"
    moved.parent.mkdir()
    workspace.root.rename(moved)
    code, out, err = curate("run", "-w", moved)
    assert (code, err) == (0, "")
    assert "0 frames done, 0 rows, 6 already done" in out
    assert dump(Workspace.open(moved)) == whole
