"""The tables against handmade results, and the files of a report."""

import json
import math
from pathlib import Path

import pytest
from support.bench_results import make_bench, synthetic_result

from pipelines.bench.grid import Job
from pipelines.bench.report import BenchReport, shown
from pipelines.bench.results import write_result
from pipelines.bench.tables import Entry, Finished, Table, all_tables

# Easy-car AP by method, ratio and seed.
CARS = {
    ("baseline", 0.25, 0): 40.0, ("baseline", 0.25, 1): 44.0,
    ("pspsl", 0.25, 0): 49.0, ("pspsl", 0.25, 1): 62.0,
    ("baseline", 0.5, 0): 60.0, ("pspsl", 0.5, 0): 66.0,
}  # fmt: skip


@pytest.fixture
def finished() -> Finished:
    """Return two methods, two ratios, two seeds; one cell at the second ratio is not finished."""
    cells = [
        synthetic_result(Job(ratio, seed, method), car)
        for (method, ratio, seed), car in CARS.items()
    ]
    return Finished([synthetic_result(Job(0.25, 0), 30.0), *cells])


def row(table: Table, name: str) -> list[str]:
    """Return a row as it is printed, without its name."""
    [found] = [row for row in table.rows if row[0] == name]
    return [shown(value) for value in found[1:]]


def table(finished: Finished, title: str) -> Table:
    """Return the table with a title that starts so."""
    return next(each for each in all_tables(finished) if each.title.startswith(title))


def test_the_table_of_a_ratio(finished: Finished) -> None:
    """Easy cars: 49, 62 are 55.5 ± 9.2, 13.5 above 40, 44; the mean has a third of the gain."""
    found = table(finished, "3D AP, IoU 0.7/0.5/0.5: 25 % labeled (2 of 8 frames)")
    assert found.columns[2:5] == ("Car\neasy", "Car\nmod.", "Car\nhard")
    assert row(found, "pspsl")[:3] == ["2", "55.5±9.2", "45.5±9.2"]
    assert row(found, "pspsl")[-2:] == ["15.2±3.1", "+4.5"]
    assert row(found, "baseline")[1] == "42.0±2.8"
    assert row(found, "baseline")[-1] == ""
    assert row(found, "teacher")[:2] == ["1", "30.0"]
    entry = found.rows[2][2]
    assert isinstance(entry, Entry)
    assert entry.full == "55.5 ± 9.2 (+13.5)"


def test_the_summary_has_a_column_per_ratio(finished: Finished) -> None:
    """The mean of nine values: (49 + 39 + 29) / 9 = 13 and (62 + 52 + 42) / 9 = 17.3."""
    found = table(finished, "mean 3D AP, IoU 0.7/0.5/0.5, by labeled ratio")
    assert found.columns == ("method", "25 %", "50 %")
    assert row(found, "pspsl") == ["15.2±3.1", "18.7"]
    assert row(found, "teacher") == ["6.7", "-"]


def test_differences_are_paired_by_seed(finished: Finished) -> None:
    """(9 / 3, 18 / 3) = (3, 6) at 25 %: 4.5 ± 12.71 * 2.12 / sqrt 2; one pair at 50 %."""
    found = table(finished, "differences of mean 3D AP")
    assert row(found, "pspsl - baseline")[:2] == ["+4.5 [-14.6, +23.6]", "+2.0"]
    # Only seed 0 has both ratios: (3 + 2) / 2.
    assert row(found, "pspsl - baseline")[2] == "+2.5"


def test_the_papers_methods_are_compared_with_all_others() -> None:
    """The others only with the baseline; no pair twice."""
    methods = ("baseline", "uda", "spsl", "pspsl")
    cells = [synthetic_result(Job(0.1, 0, method), 50.0) for method in methods]
    found = table(Finished(cells), "differences of mean BEV AP")
    assert [name for name, *_ in found.rows] == [
        "uda - baseline", "spsl - baseline", "pspsl - baseline",
        "pspsl - uda", "pspsl - spsl", "spsl - uda",
    ]  # fmt: skip


def test_labels_and_times(finished: Finished) -> None:
    """An undefined precision is a dash; a cell takes two minutes."""
    labels = table(finished, "pseudo-labels of the last round")
    assert row(labels, "pspsl") == ["100±0", "0±0", "-", "0.0±0.0", "50.0±0.0"]
    times = table(finished, "minutes per cell")
    assert row(times, "pspsl") == ["3", "2.0±0.0"]


def test_without_a_baseline_there_are_no_gains() -> None:
    tables = all_tables(Finished([synthetic_result(Job(0.1, 0, "pspsl"), 50.0)]))
    assert not any(each.title.startswith("differences") for each in tables)
    assert row(tables[0], "pspsl") == ["13.3"]
    assert all_tables(Finished([])) == []


def test_the_report_writes_markdown_json_and_a_plot(toy_kitti: Path, tmp_path: Path) -> None:
    """Markdown with gains in every cell, JSON without NaN, the command that repeats the bench."""
    bench = make_bench(tmp_path, toy_kitti, ratios=(0.25, 0.5), seeds=(0, 1))
    for (method, ratio, seed), car in CARS.items():
        write_result(tmp_path, synthetic_result(Job(ratio, seed, method), car))
    assert [path.name for path in BenchReport(bench).write()] == [
        "results.md", "results.json", "curve.png",
    ]  # fmt: skip
    text = (tmp_path / "results.md").read_text()
    assert "| pspsl | 2 | 55.5 ± 9.2 (+13.5) |" in text
    assert "--methods baseline,pspsl --ratios 0.25,0.5 --seeds 0,1 --steps 4 --rounds 1" in text
    assert "every method trains 1 x 4 steps" in text
    assert "objects of the 4 val frames" in text
    numbers = json.loads((tmp_path / "results.json").read_text(), parse_constant=pytest.fail)
    assert len(numbers["jobs"]) == len(CARS)
    [summary] = [t for t in numbers["tables"] if t["title"].startswith("mean 3D AP, IoU 0.7")]
    assert summary["rows"][2][1]["mean"] == pytest.approx(15.1667, abs=1e-3)
    [_, _, chart] = BenchReport(bench, "pdf").write()
    assert chart.read_bytes().startswith(b"%PDF")
    assert "](curve.pdf)" in (tmp_path / "results.md").read_text()


def test_cells_without_values() -> None:
    """They show a dash and no gain."""
    from curate.evaluation.comparison import Spread

    assert Entry(Spread(math.nan, math.nan, 0)).full == "-"


def test_a_figure_that_cannot_be_computed_is_in_no_mean(toy_kitti: Path, tmp_path: Path) -> None:
    """Without a counted object: "-" and null; the mean is over the others, as the report says."""
    levels = {"Car": (60.0, 40.0), "Bus": (None, 20.0)}
    thresholds = {"kitti": {"Car": 0.7, "Bus": 0.6}, "loose": {"Car": 0.5, "Bus": 0.375}}
    bench = make_bench(tmp_path / "b", toy_kitti, methods=("baseline",))
    result = synthetic_result(
        Job(0.25, 0, "baseline"),
        0.0,
        ap={name: {"3d": levels, "bev": levels} for name in thresholds},
        recall=levels,
        thresholds=thresholds,
        difficulties=("level 1", "level 2"),
        labels=(),
    )
    assert result.mean("kitti", "3d") == pytest.approx((60 + 40 + 20) / 3)
    write_result(bench.root, result)
    report = BenchReport(bench)
    found = table(report.finished, "3D AP, IoU 0.7/0.6")
    assert found.columns[2:6] == ("Car\nlevel 1", "Car\nlevel 2", "Bus\nlevel 1", "Bus\nlevel 2")
    assert row(found, "baseline") == ["1", "60.0", "40.0", "-", "20.0", "40.0", ""]
    assert row(table(report.finished, "mean 3D AP, IoU 0.5/0.375"), "baseline") == ["40.0"]
    assert "-, and not in any mean, because no object counts: Bus level 1" in report.markdown()
    numbers = json.loads(json.dumps(report.numbers(), allow_nan=False))
    assert numbers["jobs"][0]["ap"]["kitti"]["3d"]["Bus"] == [None, 20.0]


def test_a_result_without_any_figure_has_no_mean() -> None:
    """NaN, shown as "-"."""
    levels = {"Car": (None,) * 3}
    result = synthetic_result(Job(0.25, 0), 0.0, ap={"kitti": {"3d": levels}}, recall=levels)
    assert math.isnan(result.mean("kitti", "3d"))
