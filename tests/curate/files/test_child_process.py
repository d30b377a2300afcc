"""Files on which a library may end the process are read by a child process first."""

import multiprocessing
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from support import fatal_files
from support.paths import ROOT, TESTS

from curate.errors import DataError, ModelError
from curate.files import child_process
from curate.files.child_process import require_survival


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return a file."""
    (tmp_path / "a.dat").write_text("histogram size mismatch")
    return tmp_path / "a.dat"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the user's cache folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def rejected(file: Path, read, error=DataError) -> str:
    """Return the message."""
    with pytest.raises(error) as caught:
        require_survival(file, "pyarrow", read, error=error)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_an_abort_is_one_line_with_the_librarys_words(file: Path) -> None:
    """And the next file gets a new child."""
    assert rejected(file, fatal_files.abort) == (
        f"{file}: damaged: pyarrow ends the process (SIGABRT: histogram size mismatch); write the "
        "file again"
    )
    assert "exit code 23" in rejected(file, fatal_files.leave, ModelError)
    require_survival(file, "pyarrow", fatal_files.read_nothing)


def test_ordinary_errors_and_missing_files_are_left_to_the_reader(file: Path) -> None:
    """This process gets them itself."""
    require_survival(file, "pyarrow", fatal_files.fail)
    require_survival(file.with_name("missing"), "pyarrow", fatal_files.abort)


def test_a_file_that_never_ends_is_rejected(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The child is killed."""
    monkeypatch.setattr(child_process, "_MIN_SECONDS", 1.0)
    assert "has not read it within 1 s" in rejected(file, fatal_files.hang)


def test_a_child_that_says_much_does_not_block(file: Path) -> None:
    """Its output is read while it works."""
    require_survival(file, "pyarrow", fatal_files.talk)


def calls(file: Path) -> int:
    """Return how often `count` has read a file."""
    return len(file.with_suffix(".calls").read_text())


def test_a_file_is_read_once_also_by_later_commands(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until it changes."""
    for _ in range(2):
        require_survival(file, "pyarrow", fatal_files.count)
    assert calls(file) == 1
    monkeypatch.setattr(child_process, "_survived", set())  # as in another process
    require_survival(file, "pyarrow", fatal_files.count)
    assert calls(file) == 1
    file.write_text("other")
    require_survival(file, "pyarrow", fatal_files.count)
    assert calls(file) == 2


@pytest.mark.parametrize("home", ["file", "read-only", "/proc/nowhere"])
def test_a_cache_folder_that_cannot_be_written_is_not_needed(
    file: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, home: str
) -> None:
    """Then a file is read once per process."""
    (tmp_path / "file").write_text("")
    (tmp_path / "read-only").mkdir(mode=stat.S_IRUSR | stat.S_IXUSR)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / home))
    for _ in range(2):
        require_survival(file, "pyarrow", fatal_files.count)
    assert calls(file) == 1
    assert "SIGABRT" in rejected(file, fatal_files.abort)


def test_a_file_in_a_read_only_folder_is_read(file: Path) -> None:
    """Nothing is written beside it."""
    before = sorted(file.parent.iterdir())
    file.chmod(stat.S_IRUSR)
    require_survival(file, "pyarrow", fatal_files.read_nothing)
    assert [path for path in sorted(file.parent.iterdir()) if path.name != "cache"] == before


def _in_fork(file: Path, name: str, answers) -> None:
    try:
        require_survival(file, "pyarrow", getattr(fatal_files, name))
    except DataError as error:
        answers.put(str(error))
    else:
        answers.put("")


def test_a_forked_process_gets_a_child_of_its_own(file: Path) -> None:
    """Also while another thread is reading; the answers do not get mixed up."""
    require_survival(file, "pyarrow", fatal_files.read_nothing)
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    copies = [file.with_name(f"{number}.dat") for number in range(6)]
    forks = []
    for number, copy in enumerate(copies):
        copy.write_text(f"fork {number}")
        name = "abort" if number % 2 else "talk"
        forks.append(context.Process(target=_in_fork, args=(copy, name, answers), daemon=True))
    thread = threading.Thread(target=require_survival, args=(file, "pyarrow", fatal_files.talk))
    thread.start()
    for fork in forks:
        fork.start()
    said = sorted(answers.get(timeout=60) for _ in forks)
    for process in (*forks, thread):
        process.join()
    assert said[:3] == ["", "", ""]
    for number, text in zip((1, 3, 5), said[3:], strict=True):
        assert f"SIGABRT: fork {number}" in text


def test_the_child_is_cheap_and_ends_with_its_parent(file: Path) -> None:
    """It imports neither torch nor OpenCV, and is gone with a parent that is killed."""
    code = (
        "import os, sys; from pathlib import Path; from support import fatal_files\n"
        "from curate.files.child_process import _child, require_survival\n"
        "require_survival(Path(sys.argv[1]), 'pyarrow', fatal_files.read_nothing)\n"
        "maps = Path(f'/proc/{_child._process.pid}/maps').read_text()\n"
        "print(_child._process.pid, 'torch' in maps, 'cv2' in maps, flush=True)\n"
        "os.kill(os.getpid(), 9)"
    )
    environment = os.environ | {"PYTHONPATH": f"{TESTS}:{ROOT}"}
    ended = subprocess.run(
        [sys.executable, "-c", code, file], capture_output=True, text=True, check=False,
        env=environment, timeout=60,
    )  # fmt: skip
    pid, *loaded = ended.stdout.split()
    assert loaded == ["False", "False"]
    gone = Path("/proc") / pid
    for _ in range(100):
        if not gone.exists():
            break
        threading.Event().wait(0.1)
    assert not gone.exists() or "Z" in (gone / "stat").read_text().split()[2]


def test_a_child_that_was_killed_between_two_files_is_replaced(file: Path) -> None:
    """The file is not blamed for it."""
    require_survival(file, "pyarrow", fatal_files.read_nothing)
    process = child_process._child._process  # noqa: SLF001
    process.kill()
    process.wait()
    require_survival(file, "pyarrow", fatal_files.count)
    assert calls(file) == 1
