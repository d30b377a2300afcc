"""curate view: what it draws, where it leaves it, what it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.pipelines_cli import Curate

from curate.errors import ConfigError, WorkspaceError
from pipelines.labels.of_one_frame import read_frame
from pipelines.reports.pictures import draw_example_frame, picture_title
from pipelines.reports.recording import evidence_of_labels
from pipelines.workspace.workspace import Workspace


def drawn(path: Path) -> np.ndarray:
    """The picture of a file."""
    import cv2

    picture = cv2.imread(str(path))
    assert picture is not None
    return picture


@pytest.fixture
def weighted(curate: Curate, workspace: Workspace) -> Workspace:
    """Weights for X_u, predictions for val."""
    for command in ("predict", "repredict", "score", "solve"):
        code, _, err = curate(command, "-w", workspace.root)
        assert code == 0, err
    assert curate("predict", "--split", "val", "-w", workspace.root)[0] == 0
    return workspace


def test_a_frame_of_every_split_is_drawn(curate: Curate, weighted: Workspace) -> None:
    """The command says where the picture is; ground truth comes with labeled and val frames."""
    for split in ("labeled", "unlabeled", "val"):
        name = next(iter(weighted.frames(split)))
        code, out, err = curate("view", name, "-w", weighted.root)
        assert (code, err) == (0, "")
        path = Path(out.removeprefix("picture: ").strip())
        assert path.parent == weighted.root / "pictures"
        assert drawn(path).shape[1] >= 1200
        found = read_frame(weighted, name, 1, "pspsl")
        assert (found.truth_boxes is None) == (split == "unlabeled")
        assert len(found.labels) == {"labeled": 0, "unlabeled": 3, "val": 3}[split]
        assert np.isnan(found.weights).all() == (split != "unlabeled")
        content = "no predictions stored" if split == "labeled" else "weights by pspsl"
        assert (
            picture_title(name, found, 1, "pspsl") == f"frame {name} ({split}), round 1, {content}"
        )


def test_repredictions_carry_the_weight_of_their_label(weighted: Workspace) -> None:
    """In the toy world every label is matched once."""
    found = read_frame(weighted, next(iter(weighted.frames("unlabeled"))), 1, "pspsl")
    assert sorted(found.repredictions.weights) == pytest.approx(sorted(found.weights))
    assert found.repredictions.boxes.shape == (3, 7)


def test_output_and_policy_are_obeyed(curate: Curate, weighted: Workspace, tmp_path: Path) -> None:
    """Another policy colours the boxes otherwise."""
    assert curate("solve", "--policy", "uniform", "-w", weighted.root)[0] == 0
    name = next(iter(weighted.frames("unlabeled")))
    pictures = []
    for policy in ("pspsl", "uniform"):
        path = tmp_path / f"{policy} <1>.png"
        code, out, _ = curate(
            "view", name, "--policy", policy, "--round", 1, "--output", path, "-w", weighted.root
        )
        assert code == 0
        assert str(path) in out
        pictures.append(drawn(path))
    assert (pictures[0] != pictures[1]).any()


@pytest.mark.parametrize(
    ("options", "suffix", "start"),
    [
        (["--format", "pdf"], "pdf", b"%PDF"),
        (["--output", "OUT.svg"], "svg", b"<?xml"),
        (["--output", "OUT.PNG", "--format", "png"], "PNG", b"\x89PNG"),
        (["--style", "paper"], "png", b"\x89PNG"),
    ],
)
def test_the_format_is_that_of_the_option_or_of_the_suffix(
    curate: Curate,
    weighted: Workspace,
    tmp_path: Path,
    options: list[str],
    suffix: str,
    start: bytes,
) -> None:
    """PNG where neither says otherwise."""
    name = next(iter(weighted.frames("unlabeled")))
    words = [str(tmp_path / each) if each.startswith("OUT") else each for each in options]
    code, out, err = curate("view", name, *words, "-w", weighted.root)
    assert (code, err) == (0, "")
    path = Path(out.removeprefix("picture: ").strip())
    assert path.suffix == f".{suffix}"
    assert path.read_bytes().startswith(start)
    if "paper" in options:
        assert (drawn(path) == 255).all(axis=2).mean() > 0.5


def test_a_picture_shows_the_k_that_explain_takes(weighted: Workspace) -> None:
    """Also where a label before it gave way to a human one."""
    from pipelines.reports.pictures import shown_labels

    name = next(iter(weighted.frames("unlabeled")))
    found = read_frame(weighted, name, 1, "pspsl")
    frame = weighted.dataset.read(name)
    assert found.numbers.tolist() == [0, 1, 2]
    left = replace(
        found,
        labels=found.labels.select(np.array([False, True, True])),
        numbers=found.numbers[1:],
        weights=found.weights[1:],
    )
    shown = shown_labels(weighted, frame, left, "pspsl")
    assert [shown.short_caption(i) for i in range(2)] == ["k1", "k2"]
    assert shown.zero_weight == "background"
    assert shown_labels(weighted, frame, left, "st3d").zero_weight == "ignore"


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["gone"], "no frame is named 'gone'"),
        (["FRAME", "--output", "no/where.png"], "--output"),
        (["FRAME", "--format", "gif"], "--format gif: use svg, png, pdf"),
        (["FRAME", "--output", "a.png", "--format", "pdf"], "the suffix of a pdf file is .pdf"),
        (["FRAME", "--style", "light"], "--style light: use dark or paper"),
    ],
)
def test_a_wrong_call_is_one_line(
    curate: Curate, weighted: Workspace, arguments: list[str], word: str
) -> None:
    """It names what is wrong."""
    name = next(iter(weighted.frames("val")))
    words = [name if each == "FRAME" else each for each in arguments]
    code, _, err = curate("view", *words, "-w", weighted.root)
    assert code == ConfigError.exit_code
    assert word in err
    assert err.count("\n") == 1


def test_several_frames_are_several_pictures(curate: Curate, weighted: Workspace) -> None:
    """Named, or all with labels up to a limit."""
    names = list(weighted.frames("unlabeled"))
    code, out, _ = curate("view", *names[:2], "-w", weighted.root)
    assert (code, out.count("picture: ")) == (0, 2)
    code, out, _ = curate("view", "--all", "--limit", 3, "--json", "-w", weighted.root)
    assert code == 0
    pictures = json.loads(out)["pictures"]
    assert len(pictures) == 3
    assert all(name in path for name, path in zip(names[:3], pictures, strict=True))


def test_a_recording_has_a_time_line_over_the_frames(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """Every label with its stored evidence; ground truth of the val frame alone."""
    rerun = pytest.importorskip("rerun.chunk", reason="the extra [rerun] is not installed")
    val = next(iter(weighted.frames("val")))
    names = [*weighted.frames("unlabeled"), val]
    path = tmp_path / "round.rrd"
    code, out, err = curate("view", *names, "--rerun", path, "-w", weighted.root)
    assert (code, out, err) == (0, f"recording: {path}\n", "")
    rows = {}
    for chunk in rerun.RrdReader(path).store().stream():
        for row in chunk.to_record_batch().to_pylist():
            if row.get("frame") is not None:
                rows.setdefault((str(chunk.entity_path), row["frame"]), {}).update(row)
    places = range(len(names))
    assert [len(rows["/world/predictions", i]["Boxes3D:centers"]) for i in places] == [3] * 7
    truth = [len(rows["/world/ground_truth", i]["Boxes3D:centers"]) for i in places]
    assert truth == [0] * 6 + [3]
    sql = "SELECT frame, loss, rho_det, weight FROM weighted_labels ORDER BY frame, k"
    stored = json.loads(curate("query", sql, "--json", "-w", weighted.root)[1])
    for column in ("loss", "rho_det", "weight"):
        found = [value for i in range(6) for value in rows["/world/predictions", i][column]]
        assert found == pytest.approx([row[column] for row in stored])
    assert val in rows["/title", 6]["TextDocument:text"][0]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ([], "--all"),
        (["FRAME", "--all"], "--all"),
        (["FRAME", "--rerun", "a.rrd", "--output", "a.png"], "--output"),
        (["--all", "--output", "a.png"], "--output"),
    ],
)
def test_options_that_exclude_each_other_are_refused(
    curate: Curate, weighted: Workspace, arguments: list[str], word: str
) -> None:
    """One line that names them."""
    name = next(iter(weighted.frames("unlabeled")))
    words = [name if each == "FRAME" else each for each in arguments]
    code, _, err = curate("view", *words, "-w", weighted.root)
    assert code == ConfigError.exit_code
    assert word in err
    assert err.count("\n") == 1


def test_a_round_that_is_not_there_is_named(curate: Curate, weighted: Workspace) -> None:
    """Not an empty picture."""
    code, _, err = curate("view", "--all", "--round", 7, "-w", weighted.root)
    assert code == WorkspaceError.exit_code
    assert "round 7 has no predictions" in err
    code, _, err = curate("view", "--all", "--policy", "uniform", "-w", weighted.root)
    assert code == WorkspaceError.exit_code
    assert "curate solve --round 1 --policy uniform" in err


def test_without_predictions_the_remedy_is_named(curate: Curate, workspace: Workspace) -> None:
    """There is no round yet."""
    code, _, err = curate("view", "000000", "-w", workspace.root)
    assert code == WorkspaceError.exit_code
    assert "curate predict" in err


def test_example_frame_is_drawn_from_above_and_over_its_image(weighted: Workspace) -> None:
    """From above and over its image, with the labels and weights of that frame alone."""
    paths = draw_example_frame(weighted, 1)
    names = {path.name for path in paths}
    frame = next(name for name in weighted.frames("unlabeled") if any(name in n for n in names))
    assert names == {f"round-01-{frame}-bird-eye.png", f"round-01-{frame}-image.png"}
    assert all(drawn(path).size for path in paths)


def test_evidence_stays_with_its_label(weighted: Workspace) -> None:
    """Also where a label before it gave way to a human one."""
    name = next(iter(weighted.frames("unlabeled")))
    every = evidence_of_labels(weighted, name, 1, "pspsl", np.arange(3))
    some = evidence_of_labels(weighted, name, 1, "pspsl", np.array([1, 2]))
    assert len(set(every["loss"].tolist())) == 3
    for column, values in every.items():
        np.testing.assert_array_equal(some[column], values[1:])
