"""Detector that runs a command of the user on copies of the frames, and reads its results.

For every batch of frames, or of augmented copies of one view, a fresh folder gets the frames in the
data set's own layout. The command writes results in any format of `curate.detectors.recorded`:

    batches/batch-k3x9/data/         {data}: the frames, as copied by `curate.datasets.copies`
    batches/batch-k3x9/frames.txt    {frames}: their names
    batches/batch-k3x9/results/      {results}: where the command writes
    logs/round-1-view-1-000123.log   what it printed
"""

import inspect
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from curate.datasets.base import Dataset
from curate.datasets.copies import copy_writer
from curate.datasets.frame_names import FrameNames
from curate.detections import Detections
from curate.detectors.command.batch_folders import BatchFolders
from curate.detectors.option_names import name_results_options, results_options_named
from curate.detectors.recorded import RecordedDetector
from curate.detectors.recorded.formats import SUFFIXES, check_kind
from curate.errors import ConfigError, CurateError, DataError, ModelError, one_line
from curate.files.paths import StrPath
from curate.files.user_command import (
    UserCommand,
    describe_end,
    describe_missing,
    fill,
    path_from,
)
from curate.frames import Calibration, Frame, RotationY
from curate.geometry.augmented_views import augmented_calibration
from curate.geometry.mounting import rotation_y_of_tools
from curate.geometry.similarity import Similarity
from curate.option_values import describe_wrong_values
from curate.ranges import AboveZero, Share
from curate.spelling import did_you_mean

PLACEHOLDERS = ("clouds", "data", "results", "frames", "teacher", "round")
_TITLE = "detector.options.command"
# The path, the frames and the copies come from the batch, not from the user.
_GIVEN = {
    "path", "minimum_score", "passes", "augmented", "frame_ids", "only_these", "calibration",
    "wants_views", "rename",
}  # fmt: skip
_QUOTED_BYTES, _QUOTED_LINES, _QUOTED_LENGTH = 4096, 3, 300
_KEPT_LOG_BYTES = 1 << 20


class CommandDetector:
    """A `Detector` and `CopiesDetector` that runs a command of the user.

    Args:
        path: checkpoint of the teacher, for {teacher}; None without one.
        minimum_score: boxes with a lower score are left out.
        command: the program and its arguments, see `curate.files.user_command`; with the
            placeholders {clouds} (folder of the point files), {data} (root of the frames in the
            data set's layout), {results} (folder to write to), {frames} (file of frame names),
            {teacher} and {round}.
        results: how the results are read: the options of `RecordedDetector`, such as kind, classes
            and rotation_y, and `path` within {results} (a name or a pattern). Placeholders are
            replaced here too.
        files: files that the predictions depend on, such as the configuration of the model,
            relative to `folder`. A change of their content makes predictions outdated; the detector
            does not read them.
        camera_view: whether the copies have only the points that a camera sees.
        timeout_s: seconds after which the command is ended.
        open_dataset: opens the data set.
        folder: folder in which the command runs and `batches` and `logs` are created.
        round_number: number of the round, for {round}.

    Raises:
        ConfigError: if the command or an option is invalid, or the program or a file does not
            exist.
    """

    def __init__(
        self,
        path: StrPath | None,
        minimum_score: Share = 0.0,
        *,
        command: str = "",
        results: Mapping[str, Any] | None = None,
        files: Sequence[str] = (),
        camera_view: bool = False,
        timeout_s: AboveZero = 3600.0,
        open_dataset: Callable[[], Dataset],
        folder: StrPath = ".",
        round_number: int = 1,
    ) -> None:
        self._folder = Path(folder).absolute()
        self._command = UserCommand.parse(_TITLE, command)
        _check_placeholders(self._command)
        self._results = dict(results or {})
        _check_results(self._results)
        if isinstance(files, str):
            raise ConfigError(f'detector.options.files: write a list, ["{files}"]')
        for name in files:
            if not path_from(self._folder, name).exists():
                missing = describe_missing(name, self._folder)
                raise ConfigError(f"detector.options.files: {missing}")
        self._path = "" if path is None else str(Path(path).absolute())
        if "teacher" in self._command.placeholders() and path is None:
            raise ConfigError(
                f"{_TITLE}: uses {{teacher}}, but detector.path, the checkpoint of the first "
                "round, is not set"
            )
        self._command.check(self._folder)
        self._minimum_score = minimum_score
        self._camera_view = camera_view
        self._timeout_s = timeout_s
        self._open_dataset = open_dataset
        self._folders = BatchFolders(self._folder)
        self._round_number = round_number

    @classmethod
    def batch_size(cls, device: str) -> int:  # noqa: ARG003 - the command chooses its device
        """Return how many frames a command gets: enough to load its model rarely."""
        return 100

    def predict(self, frame: Frame) -> Detections:
        """Return what the command finds in the files of a frame; `frame.points` is not used.

        Raises:
            ModelError: if the command fails.
            DataError: if the frame cannot be copied, or has no valid result.
        """
        [found] = self.predict_copies({frame.frame_id: None})
        if isinstance(found, CurateError):
            raise found
        return found

    def predict_copies(
        self, copies: Mapping[str, Similarity | None], view: int = 0
    ) -> list[Detections | CurateError]:
        """Return what the command finds in each copy, see `CopiesDetector`."""
        first = next(iter(copies)).replace("/", "-")
        name = f"round-{self._round_number}-" + (f"view-{view}-" if view else "") + first
        with self._folders.new() as folder:
            found = self._found(folder, name, copies)
            if not any(isinstance(each, ModelError) for each in found.values()):
                return [found[frame_id] for frame_id in copies]
            kept = self._folders.keep(folder, name)
            return [_moved(found[frame_id], folder, kept) for frame_id in copies]

    def rotation_y_of_copies(self, calibration: Calibration) -> RotationY:
        """Return how rotation_y of results of copies is read, for the calibration of a frame."""
        declared: RotationY | None = self._results.get("rotation_y")
        return declared or rotation_y_of_tools(calibration)

    @cached_property
    def _dataset(self) -> Dataset:
        self._folders.remove_stale()
        return self._open_dataset()

    def _found(
        self, folder: Path, name: str, copies: Mapping[str, Similarity | None]
    ) -> dict[str, Detections | CurateError]:
        """Copy the frames, run the command, and return the result or the error of each frame.

        Every error that is not one of the data set is a ModelError.
        """
        found: dict[str, Detections | CurateError] = {}
        try:
            values = self._prepare(folder, copies, found)
        except CurateError as error:
            return dict.fromkeys(copies, error)
        frames = [frame_id for frame_id in copies if frame_id not in found]
        if not frames:
            return found
        log = self._folders.log(name)
        try:
            self._execute(values, log, frames)
        except CurateError as error:
            return found | dict.fromkeys(frames, error)
        try:
            record = self._read(values, {frame_id: copies[frame_id] for frame_id in frames})
            missing = set(record.missing_frames(frames))
        except CurateError as error:
            failure = ModelError(f"{_TITLE}: its results cannot be used: {error}; see {log}")
            return found | dict.fromkeys(frames, failure)
        for frame_id in frames:
            try:
                if frame_id in missing:
                    raise ModelError(
                        f"frame {frame_id}: {_TITLE} wrote no result for it; a frame without "
                        f"objects needs an empty result; see {log} and {folder}"
                    )
                found[frame_id] = record.predict_recorded(frame_id)
            except CurateError as error:
                found[frame_id] = ModelError(str(error))
        return found

    def _prepare(
        self,
        folder: Path,
        copies: Mapping[str, Similarity | None],
        found: dict[str, Detections | CurateError],
    ) -> dict[str, str]:
        """Write the copies, and return the values of the placeholders."""
        data, results, frames = folder / "data", folder / "results", folder / "frames.txt"
        results.mkdir()
        writer = copy_writer(self._dataset, data, copies, camera_view=self._camera_view)
        try:
            writer.prepare()
            for frame_id in writer.frame_ids:
                try:
                    writer.write(frame_id)
                except CurateError as error:
                    found[frame_id] = error
            written = [frame_id for frame_id in writer.frame_ids if frame_id not in found]
            if found and written:  # the lists must not have frames without files
                given = {frame_id: copies[frame_id] for frame_id in written}
                copy_writer(self._dataset, data, given, camera_view=self._camera_view).prepare()
            frames.write_text("".join(f"{frame_id}\n" for frame_id in written))
        except OSError as error:
            raise DataError(
                f"{data}: the frames cannot be copied: {one_line(error)}; free some space, or set "
                "detector.batch_size to fewer frames"
            ) from error
        return {
            "clouds": str(data / writer.clouds),
            "data": str(data),
            "results": str(results),
            "frames": str(frames),
            "teacher": self._path,
            "round": str(self._round_number),
        }

    def _execute(self, values: Mapping[str, str], log: Path, frames: Sequence[str]) -> None:
        """Run the command.

        Raises:
            ModelError: if it fails, takes too long, or writes nothing.
        """
        with log.open("wb") as output:
            output.write(f"$ {shlex.join(self._command.filled(values))}\n".encode())
            output.flush()
            code = self._command.run(values, output, self._timeout_s, self._folder)
        _shorten(log)
        if code == 0 and any(Path(values["results"]).iterdir()):
            return
        if code is None:
            problem = (
                f"had not finished after {self._timeout_s:g} s (detector.timeout_s) and was ended"
            )
        elif code:
            problem = f"ended with {describe_end(code)}"
        else:
            problem = "wrote nothing to {results}"
        batch = f"frame {frames[0]}" + (f" to {frames[-1]}" if len(frames) > 1 else "")
        raise ModelError(
            f"{_TITLE}: `{self._command.short}` {problem} on {batch}{_last_lines(log)}; see {log}; "
            f"input and output are kept in {Path(values['results']).parent}"
        )

    def _read(
        self, values: Mapping[str, str], copies: Mapping[str, Similarity | None]
    ) -> RecordedDetector:
        """Return the results.

        Raises:
            CurateError: if they cannot be read, or are results of other frames.
        """
        options: dict[str, Any] = dict(self._results)
        for key, value in self._results.items():
            if isinstance(value, str):
                options[key] = fill(value, values)
        path, kind = _find_results(Path(values["results"]), options.pop("path", None), copies)
        options.setdefault("kind", kind)
        with results_options_named():
            return RecordedDetector(
                path,
                self._minimum_score,
                frame_ids=tuple(copies),
                only_these=True,
                calibration=lambda frame_id: self._calibration(frame_id, copies[frame_id]),
                wants_views=False,
                **options,
            )

    def _calibration(self, frame_id: str, similarity: Similarity | None) -> Calibration:
        """Return the calibration of a copy, with the meaning of rotation_y in its results."""
        calibration = self._dataset.read(frame_id, points=False).calibration
        if similarity is None:
            return calibration
        copied = augmented_calibration(calibration, similarity)
        return replace(copied, rotation_y=self.rotation_y_of_copies(calibration))


def _moved(found: Detections | CurateError, folder: Path, kept: Path) -> Detections | CurateError:
    """Return an error that refers to the folder that was kept."""
    if isinstance(found, Detections):
        return found
    return type(found)(name_results_options(str(found).replace(str(folder), str(kept))))


def _check_placeholders(command: UserCommand) -> None:
    """Check the placeholders of a command; without any it reads the environment.

    Raises:
        ConfigError: if a placeholder is unknown or missing.
    """
    command.check_placeholders(PLACEHOLDERS)
    used = command.placeholders()
    if used and "results" not in used:
        raise ConfigError(
            f"{_TITLE}: has no {{results}}, the folder for its results; add it (or use no "
            "placeholders at all, and read $CURATE_RESULTS)"
        )
    if used and not {"clouds", "data"} & {*used}:
        raise ConfigError(
            f"{_TITLE}: has neither {{data}} nor {{clouds}}, the frames that it must read; add one "
            "(or use no placeholders at all, and read $CURATE_DATA)"
        )


def _check_results(results: Mapping[str, Any]) -> None:
    """Raise ConfigError if `detector.options.results` has an unknown key or a wrong value."""
    names = ["path", *(each for each in inspect.signature(RecordedDetector).parameters)]
    known = [name for name in dict.fromkeys(names) if name not in _GIVEN or name == "path"]
    for key in results:
        if key not in known:
            hint = "; set detector.rename" if key == "rename" else did_you_mean(key, known)
            raise ConfigError(
                f"detector.options.results has no '{key}'{hint}; it has {', '.join(known)}"
            )
    if wrong := describe_wrong_values(RecordedDetector, results):
        raise ConfigError(f"detector.options.results.{wrong}")
    with results_options_named():
        check_kind(results.get("kind", "auto"))
    pattern = results.get("path", ".")
    if not isinstance(pattern, str) or Path(pattern).is_absolute():
        raise ConfigError(
            f"detector.options.results.path {pattern!r}: write a name or pattern within {{results}}"
        )


def _find_results(
    results: Path, pattern: str | None, frame_ids: Collection[str]
) -> tuple[Path, str]:
    """Return the file or folder of the results, and its kind if the names of the files show it.

    The results are what a pattern fits, or the only file, or the files with names of frames, or
    the only file that can hold the results of several frames: there may be logs beside it.

    Raises:
        ModelError: if nothing or several paths fit.
    """
    if pattern is not None:
        found = sorted(results.glob(pattern))
        if len(found) != 1:
            shown = ", ".join(str(each.relative_to(results)) for each in found[:3]) or "nothing"
            raise ModelError(
                f"{results}: {shown} fits detector.options.results.path = {pattern!r}; one result "
                "was expected"
            )
        return found[0], "auto"
    files = [each for each in results.iterdir() if not each.name.startswith(".")]
    if len(files) == 1 and files[0].is_file() and files[0].stem not in frame_ids:
        return files[0], "auto"
    separate = [each for each in results.rglob("*") if each.suffix in (".txt", ".json")]
    frames = FrameNames(frame_ids)
    of_frames = [
        each for each in separate if frames.find(each.relative_to(results).as_posix()) is not None
    ]
    suffixes = {each.suffix for each in of_frames}
    parents = {each.parent for each in of_frames}
    if suffixes == {".txt"}:
        return results, "kitti"
    if suffixes == {".json"} and len(parents) == 1:
        return parents.pop(), "mmdetection3d"
    whole = [each for each in files if each.suffix.lower() in SUFFIXES and each.is_file()]
    if not suffixes and len(whole) == 1:
        return whole[0], "auto"
    if separate and not whole:
        return results, "auto"  # under other names than those of the frames: the error lists them
    names = ", ".join(sorted(each.name for each in files)[:3])
    raise ModelError(
        f"{results}: contains {names}; set detector.options.results.path to the file of the results"
    )


def _last_lines(log: Path) -> str:
    """Return the last lines of a log for a message; "" if the command printed nothing."""
    with log.open("rb") as file:
        command = file.readline()
        start = file.tell()
        file.seek(max(start, log.stat().st_size - _QUOTED_BYTES))
        text = file.read().decode(errors="replace")
    del command
    lines = [" ".join(line.split()) for line in text.splitlines()]
    said = " | ".join([line for line in lines if line][-_QUOTED_LINES:])
    said = "".join(each for each in said if each.isprintable())
    return f": {said[-_QUOTED_LENGTH:]}" if said else ""


def _shorten(log: Path) -> None:
    """Keep only the end of a long log."""
    with suppress(OSError):
        size = log.stat().st_size
        if size > _KEPT_LOG_BYTES:
            with log.open("rb") as file:
                head = file.readline()[:_QUOTED_BYTES]
                file.seek(size - _KEPT_LOG_BYTES)
                tail = file.read()
            log.write_bytes(head.rstrip(b"\n") + b"\n...\n" + tail)
