"""`curate view`: its plots, their paths, and invalid input."""

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


def drawn_image(path: Path) -> np.ndarray:
    """Return the image in a file."""
    import cv2

    image = cv2.imread(str(path))
    assert image is not None
    return image


@pytest.fixture
def weighted(curate: Curate, workspace: Workspace) -> Workspace:
    """Create weights for X_u and predictions for val."""
    for command in ("predict", "repredict", "score", "solve"):
        code, _, err = curate(command, "-w", workspace.root)
        assert code == 0, err
    assert curate("predict", "--split", "val", "-w", workspace.root)[0] == 0
    return workspace


def test_a_frame_of_every_split_is_drawn(curate: Curate, weighted: Workspace) -> None:
    """The command prints the path; labeled and val frames show ground truth."""
    for split in ("labeled", "unlabeled", "val"):
        name = next(iter(weighted.frames(split)))
        code, out, err = curate("view", name, "-w", weighted.root)
        assert (code, err) == (0, "")
        path = Path(out.removeprefix("picture: ").strip())
        assert path.parent == weighted.root / "pictures"
        assert drawn_image(path).shape[1] >= 1200
        found = read_frame(weighted, name, 1, "pspsl")
        assert (found.truth_boxes is None) == (split == "unlabeled")
        assert len(found.labels) == {"labeled": 0, "unlabeled": 3, "val": 3}[split]
        assert np.isnan(found.weights).all() == (split != "unlabeled")
        content = "no predictions stored" if split == "labeled" else "weights by pspsl"
        assert (
            picture_title(name, found, 1, "pspsl") == f"frame {name} ({split}), round 1, {content}"
        )


def test_repredictions_have_the_weight_of_their_label(weighted: Workspace) -> None:
    """In the toy world every label is matched once."""
    found = read_frame(weighted, next(iter(weighted.frames("unlabeled"))), 1, "pspsl")
    assert sorted(found.repredictions.weights) == pytest.approx(sorted(found.weights))
    assert found.repredictions.boxes.shape == (3, 7)


def test_the_options_for_output_and_policy_are_used(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """Another policy colours the boxes differently."""
    assert curate("solve", "--policy", "uniform", "-w", weighted.root)[0] == 0
    name = next(iter(weighted.frames("unlabeled")))
    images = []
    for policy in ("pspsl", "uniform"):
        path = tmp_path / f"{policy} <1>.png"
        code, out, _ = curate(
            "view", name, "--policy", policy, "--round", 1, "--output", path, "-w", weighted.root
        )
        assert code == 0
        assert str(path) in out
        images.append(drawn_image(path))
    assert (images[0] != images[1]).any()


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
    """The default is PNG."""
    name = next(iter(weighted.frames("unlabeled")))
    words = [str(tmp_path / each) if each.startswith("OUT") else each for each in options]
    code, out, err = curate("view", name, *words, "-w", weighted.root)
    assert (code, err) == (0, "")
    path = Path(out.removeprefix("picture: ").strip())
    assert path.suffix == f".{suffix}"
    assert path.read_bytes().startswith(start)
    if "paper" in options:
        assert (drawn_image(path) == 255).all(axis=2).mean() > 0.5


def test_a_plot_shows_the_k_that_explain_takes(weighted: Workspace) -> None:
    """Also if an earlier label was replaced by a human one."""
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
        (["gone"], "there is no frame 'gone'"),
        (["FRAME", "--output", "no/where.png"], "--output"),
        (["FRAME", "--format", "gif"], "--format gif: use svg, png, pdf"),
        (["FRAME", "--output", "a.png", "--format", "pdf"], "the suffix of a pdf file is .pdf"),
        (["FRAME", "--style", "light"], "--style light: use dark or paper"),
    ],
)
def test_a_wrong_call_gives_a_one_line_error(
    curate: Curate, weighted: Workspace, arguments: list[str], word: str
) -> None:
    name = next(iter(weighted.frames("val")))
    words = [name if each == "FRAME" else each for each in arguments]
    code, _, err = curate("view", *words, "-w", weighted.root)
    assert code == ConfigError.exit_code
    assert word in err
    assert err.count("\n") == 1


def test_several_frames_give_several_plots(curate: Curate, weighted: Workspace) -> None:
    """The listed frames, or all with labels up to a limit."""
    names = list(weighted.frames("unlabeled"))
    code, out, _ = curate("view", *names[:2], "-w", weighted.root)
    assert (code, out.count("picture: ")) == (0, 2)
    code, out, _ = curate("view", "--all", "--limit", 3, "--json", "-w", weighted.root)
    assert code == 0
    images = json.loads(out)["pictures"]
    assert len(images) == 3
    assert all(name in path for name, path in zip(names[:3], images, strict=True))


def test_a_recording_has_a_time_line_over_the_frames(
    curate: Curate, weighted: Workspace, tmp_path: Path
) -> None:
    """Every label has its stored evidence; only the val frame has ground truth."""
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
def test_options_that_exclude_each_other_are_rejected(
    curate: Curate, weighted: Workspace, arguments: list[str], word: str
) -> None:
    """The one-line error contains both."""
    name = next(iter(weighted.frames("unlabeled")))
    words = [name if each == "FRAME" else each for each in arguments]
    code, _, err = curate("view", *words, "-w", weighted.root)
    assert code == ConfigError.exit_code
    assert word in err
    assert err.count("\n") == 1


def test_a_missing_round_is_reported(curate: Curate, weighted: Workspace) -> None:
    """There is no empty plot."""
    code, _, err = curate("view", "--all", "--round", 7, "-w", weighted.root)
    assert code == WorkspaceError.exit_code
    assert "round 7 has no predictions" in err
    code, _, err = curate("view", "--all", "--policy", "uniform", "-w", weighted.root)
    assert code == WorkspaceError.exit_code
    assert "curate solve --round 1 --policy uniform" in err


def test_without_predictions_the_error_says_what_to_do(
    curate: Curate, workspace: Workspace
) -> None:
    """There is no round yet."""
    code, _, err = curate("view", "000000", "-w", workspace.root)
    assert code == WorkspaceError.exit_code
    assert "curate predict" in err


def test_example_frame_is_drawn_from_above_and_over_its_image(weighted: Workspace) -> None:
    """Both show the labels and weights of that frame only."""
    paths = draw_example_frame(weighted, 1)
    names = {path.name for path in paths}
    frame = next(name for name in weighted.frames("unlabeled") if any(name in n for n in names))
    assert names == {f"round-01-{frame}-pspsl-{kind}.png" for kind in ("bird-eye", "image")}
    assert all(drawn_image(path).size for path in paths)


def test_evidence_stays_with_its_label(weighted: Workspace) -> None:
    """Also if an earlier label was replaced by a human one."""
    name = next(iter(weighted.frames("unlabeled")))
    every = evidence_of_labels(weighted, name, 1, "pspsl", np.arange(3))
    some = evidence_of_labels(weighted, name, 1, "pspsl", np.array([1, 2]))
    assert len(set(every["loss"].tolist())) == 3
    for column, values in every.items():
        np.testing.assert_array_equal(some[column], values[1:])
