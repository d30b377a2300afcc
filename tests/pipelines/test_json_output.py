"""`--json`: one JSON document on standard output, from every command that has the option."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from support.bench_results import make_bench, synthetic_result
from support.pipelines_cli import Curate, with_option

from curate.errors import FramesFailed
from pipelines.bench.grid import Job
from pipelines.bench.results import write_result
from pipelines.reports.terminal import print_json

Arguments = Sequence[object]


def parsed(text: str) -> Any:
    """Parse a JSON document, and reject NaN and Infinity, which JSON does not define."""

    def reject(word: str) -> None:
        pytest.fail(f"{word} is not JSON")

    return json.loads(text, parse_constant=reject)


def commands_in_order(root: Path, data: Path) -> Mapping[str, Arguments]:
    """Return arguments for each command, in an order in which each finds what it needs."""
    work, review = root / "work", root / "review"
    results = root / "results"
    results.mkdir()
    for path in (data / "training" / "label_2").glob("*.txt"):
        (results / path.name).write_text("")
    detector = "support.trainable_toy:GridDetector"
    short = ("train.pretrain_steps=4", "train.round_steps=4", "run.rounds=2")
    there = ("-w", work)
    return {
        "simulate": (root / "data", "--frames", 4),
        "init": (
            work, "--root", data, "--labeled", 0.25, "--detector", detector,
            "--segmenter", "support.toys:ToySegmenter", "--segmenter-path", results,
            *(word for setting in short for word in ("--set", setting)),
        ),
        "graph": there,
        "status": there,
        "doctor": there,
        "pretrain": there,
        "segment": there,
        "augment": (root / "copies", *there),
        "predict": there,
        "repredict": there,
        "score": there,
        "calibrate": there,
        "solve": there,
        "export": there,
        "train-round": there,
        "run": there,
        "export-model": there,
        "check": there,
        "query": ("SELECT 1e400 AS far, count(*) AS labels FROM weighted_labels", *there),
        "explain": ("FRAME", 0, *there),
        "view": ("FRAME", *there),
        "report": there,
        "diff": (1, 2, *there),
        "next": ("--frames", 1, *there),
        "suspects": ("--split", "val", *there),
        "propose": there,
        "review export": (review, "--count", 1, *there),
        "review import": (review, "--accept", "all", *there),
        "review list": there,
        "review clear": ("--all", *there),
        "evaluate": ("--labels", data / "training" / "label_2", "--results", results),
        "audit": ("--round", 2, "--replicates", 10, *there),
        "bench": (root / "bench", "--report"),
    }  # fmt: skip


def test_every_command_with_the_option_prints_one_document(
    curate: Curate, tmp_path: Path, toy_kitti: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new command with the option must be added to the list."""
    monkeypatch.setattr("curate.simulation.simulate", lambda *_, **__: None)
    job = Job(0.25, 0, "pspsl")
    bench = make_bench(tmp_path / "bench", toy_kitti)
    write_result(bench.root, synthetic_result(job, 50.0))
    steps = commands_in_order(tmp_path, toy_kitti)
    assert with_option("--json") == set(steps)
    frame = ""
    for name, arguments in steps.items():
        given = [frame if each == "FRAME" else each for each in arguments]
        code, out, err = curate(*name.split(), *given, "--json")
        # One check of doctor fails for the toy detector, which was not trained yet.
        assert code == (1 if name == "doctor" else 0), (name, err)
        document = parsed(out)
        assert document, name
        if name == "run":
            query = "SELECT frame FROM weighted_labels WHERE k = 0 ORDER BY round DESC"
            found = parsed(curate("query", query, "-w", tmp_path / "work", "--json")[1])
            frame = found[0]["frame"]


@pytest.mark.parametrize("form", ["kitti", "csv", "sqlite"])
def test_every_format_of_an_export_is_reported_as_json(
    curate: Curate, workspace: Any, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    """With the number of labels, and the path in the summary."""
    monkeypatch.chdir(workspace.root)
    assert curate("run")[0] == 0
    code, out, err = curate("export", "--format", form, "--output", f"labels.{form}", "--json")
    assert (code, err) == (0, "")
    [report] = parsed(out)
    assert (report["stage"], report["round"], report["labels"]) == ("export", 1, 18)
    assert f"labels.{form}" in report["summary"]


def test_failed_frames_give_a_document_and_an_error_line(
    curate: Curate, workspace: Any, toy_kitti: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The document is on standard output, the line on standard error."""
    monkeypatch.chdir(workspace.root)
    name = min(workspace.frames("unlabeled"))
    (toy_kitti / "training" / "calib" / f"{name}.txt").unlink()
    code, out, err = curate("predict", "--json")
    assert code == FramesFailed.exit_code
    assert parsed(out)[0]["failed"] == 1
    assert err.startswith("error: ")
    assert err.count("\n") == 1


def test_values_that_json_does_not_define_are_null(capsys: pytest.CaptureFixture) -> None:
    """Also in nested values."""
    print_json({"a": [float("nan"), {"b": float("-inf")}], "c": 0.5})
    assert parsed(capsys.readouterr().out) == {"a": [None, {"b": None}], "c": 0.5}
