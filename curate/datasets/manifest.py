"""manifest.json of a folder of augmented copies: which A each copy has, and what it was made from.

    OUT/manifest.json
    OUT/view-1/       a data set with one copy of each frame, under the frame's name
    OUT/view-1/result*    what a detector found in these copies: put here by the user
    OUT/view-2/       the second copy of each frame, if there are several

The content depends on frames and parameters only, so all shards write the same file.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from curate.datasets.base import Dataset
from curate.errors import ConfigError, DataError, one_line
from curate.files.atomic import replace_file
from curate.files.json_text import read_json
from curate.frames import RotationY
from curate.geometry.augmented_views import AugmentedViews
from curate.geometry.mounting import check_rotation_y
from curate.geometry.similarity import Similarity

NAME = "manifest.json"
_FORMAT, _VERSION = "curate augmented copies", 1
_TRANSFORM = (
    "y := -y if flip_y, then a rotation about z by rotation_rad (counter-clockwise), then x, y, z "
    "times scale; LiDAR frame: x forward, y left, z up, metres"
)
# Frames of which the manifest has a hash of the size and the beginning of the points.
_SAMPLED, _SAMPLED_BYTES = 16, 1 << 16


@dataclass(frozen=True)
class Manifest:
    """The content of a manifest.

    Attributes:
        split: split of the frames.
        drawn: how A of each copy was drawn.
        camera_view: whether the copies have only the points that a camera sees.
        dataset_kind: kind of the data set of the frames.
        samples: hashes of some frames, see `sample_hashes`.
        copies_kind: kind of data set that each view is.
        rotation_y: meaning of rotation_y in results in KITTI's form for the copies.
        frames: A of each view of each frame.
    """

    split: str
    drawn: AugmentedViews
    camera_view: bool
    dataset_kind: str
    samples: Mapping[str, str]
    copies_kind: str
    rotation_y: RotationY
    frames: Mapping[str, Sequence[Similarity]]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Return the manifest of a folder.

        Raises:
            DataError: if there is none, or it is damaged or of another version.
        """
        path = folder / NAME
        if not path.exists():
            raise DataError(
                f"{path}: no such file; write the copies with `curate augment`, or correct the "
                "path of their folder"
            )
        content = read_json(path, "manifest")
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise DataError(f"{path}: not the manifest of `curate augment`")
        if content.get("version") != _VERSION:
            raise DataError(
                f"{path}: version {content.get('version')!r}, this curate reads {_VERSION}; write "
                "the copies again into an empty folder"
            )
        try:
            drawn = content["drawn"]
            found = cls(
                str(content["split"]),
                AugmentedViews(**{**drawn, "scale_range": tuple(drawn["scale_range"])}),
                bool(content["copies"]["camera_view"]),
                str(content["dataset"]["kind"]),
                dict(content["dataset"]["samples"]),
                str(content["copies"]["kind"]),
                content["copies"]["rotation_y"],
                {name: _similarities(rows) for name, rows in content["frames"].items()},
            )
            check_rotation_y(found.rotation_y, "copies.rotation_y")
        except (AttributeError, ConfigError, KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"{path}: damaged, {one_line(error, 200)}; run `curate augment` into an empty "
                "folder"
            ) from None
        if any(len(views) != found.drawn.views for views in found.frames.values()):
            raise DataError(f"{path}: damaged, frames with another number of views")
        return found

    def check_place(self, folder: Path) -> None:
        """Check that copies can be written into a folder.

        Raises:
            DataError: if it contains other copies, or files without a manifest.
        """
        path = folder / NAME
        if path.exists():
            found = self.read(folder)
            difference = found.difference(self)
            if found.camera_view != self.camera_view:
                with_option, without = ("with", "without")[:: 1 if found.camera_view else -1]
                difference = f"copies {with_option} --camera-view, requested {without} it"
            if difference:
                raise DataError(
                    f"{path}: {difference}; choose an empty folder, or delete this one first"
                )
        elif folder.exists() and (
            not folder.is_dir() or any(each.name[0] != "." for each in folder.iterdir())
        ):
            raise DataError(f"{folder}: contains files, but no {NAME}; choose an empty folder")

    def write(self, folder: Path) -> None:
        """Write the manifest, unless it is there; see `check_place`."""
        if not (folder / NAME).exists():
            replace_file(folder / NAME, self._text().encode())

    def difference(self, expected: "Manifest") -> str:
        """Return in which way the copies are not the expected ones; "" if they are."""
        return next(self._differences(expected), "")

    def _differences(self, expected: "Manifest") -> Iterator[str]:
        for name, value in asdict(expected.drawn).items():
            found = getattr(self.drawn, name)
            if found != value:
                yield f"copies of {name.removesuffix('_number')} {found}, expected {value}"
        if self.split != expected.split:
            yield f"copies of split {self.split}, expected {expected.split}"
        if self.dataset_kind != expected.dataset_kind:
            yield f"copies of a data set '{self.dataset_kind}', not '{expected.dataset_kind}'"
        missing = [name for name in expected.frames if name not in self.frames]
        if missing or len(self.frames) > len(expected.frames):
            shown = f"; {missing[0]} is not among them" if missing else ""
            yield (
                f"copies of {len(self.frames)} {self.split} frames, but the split has "
                f"{len(expected.frames)}{shown}"
            )
        elif 2 * len(self.samples.items() & expected.samples.items()) < len(expected.samples):
            # Some may differ: a damaged file that has been fixed.
            yield "copies of other frames with the same names: the points differ"
        elif any(tuple(self.frames[name]) != tuple(a) for name, a in expected.frames.items()):
            yield "A of a frame is not the one that curate draws: the file was changed"

    def _text(self) -> str:
        head = {
            "format": _FORMAT,
            "version": _VERSION,
            "split": self.split,
            "drawn": asdict(self.drawn),
            "dataset": {"kind": self.dataset_kind, "samples": self.samples},
            "copies": {
                "kind": self.copies_kind,
                "folders": [view_folder(view).name for view in range(self.drawn.views)],
                "camera_view": self.camera_view,
                "rotation_y": self.rotation_y,
                "transform": _TRANSFORM,
            },
        }
        rows = [
            f"{json.dumps(name)}: {json.dumps([asdict(each) for each in views])}"
            for name, views in self.frames.items()
        ]
        frames = ",\n  ".join(rows)
        return f'{json.dumps(head, indent=1)[:-2]},\n "frames": {{\n  {frames}\n }}\n}}\n'


def view_folder(view: int, folder: Path = Path()) -> Path:
    """Return the folder of a view, counted from 0."""
    return folder / f"view-{view + 1}"


def results_of(view: int, folder: Path) -> Path:
    """Return the results of a view: the only file or folder result* in its folder.

    The inferencer of mmdetection3d writes a folder preds into that folder.

    Raises:
        DataError: if there is none, or there are several.
    """
    home = view_folder(view, folder)
    found = sorted(path for path in home.glob("result*") if path.suffix != ".partial")
    if len(found) == 1:
        inner = found[0] / "preds"
        return inner if inner.is_dir() else found[0]
    if found:
        listed = " and ".join(path.name for path in found[:2])
        raise DataError(f"{home}: contains {listed}; remove all results but one")
    raise DataError(
        f"{home}: no results of the copies; run the detector on this folder, and put its results "
        f"there as {home / 'results'} (a folder), or as a file such as result.pkl or results.json"
    )


def sample_hashes(dataset: Dataset, frame_ids: Sequence[str]) -> Mapping[str, str]:
    """Return hashes of some frames, which tell a data set from others with the same frame names.

    A hash is that of the size and the beginning of the point file.

    Raises:
        DataError: if a frame does not exist.
    """
    found = {}
    for frame_id in frame_ids[:: max(1, len(frame_ids) // _SAMPLED)]:
        path = dataset.files(frame_id).points
        try:
            with path.open("rb") as file:
                content = f"{path.stat().st_size}\0".encode() + file.read(_SAMPLED_BYTES)
        except OSError:
            content = b"missing"  # the frame fails when it is read
        found[frame_id] = hashlib.sha256(content).hexdigest()[:16]
    return found


def _similarities(rows: Any) -> tuple[Similarity, ...]:
    """Return A of each view of a frame."""
    return tuple(
        Similarity(bool(row["flip_y"]), float(row["rotation_rad"]), float(row["scale"]))
        for row in rows
    )
