"""The page of the benchmarks contains the measurements, and nothing about the machine's owner."""

import ast
import json
from pathlib import Path

import pytest
from benchmarks.report import OURS, main, render, summarise

HERE = Path(__file__).parent


def measured(*lines):
    """Return a document as pytest-benchmark writes it."""
    return {
        "machine_info": {
            "node": "secret-host",
            "cpu": {"brand_raw": "Some CPU", "count": 2},
            "python_version": "3.11.2",
        },
        "commit_info": {"branch": "secret-branch"},
        "benchmarks": list(lines),
    }


def line(group, name, seconds, *, figure="ratio", target=None, amount=100, timer="process_time"):
    """Return one benchmark of such a document."""
    info = {"name": name, "figure": figure, "amount": amount, "unit": "boxes", "target_s": target}
    info["clock_s"] = 3 * seconds
    stats = {"min": seconds, "median": 2 * seconds, "rounds": 5}
    options = {"timer": timer}
    return {"group": group, "extra_info": info, "stats": stats, "options": options}


def test_ratios_are_multiples_of_our_time() -> None:
    """Within a group, wherever our line is."""
    summary = summarise(measured(line("NMS", "peer", 0.5), line("NMS", OURS, 0.25)), {}, 1.0)
    [peer, ours] = summary["groups"]["NMS"]
    assert (peer["ratio"], ours["ratio"]) == (2.0, 1.0)
    assert ours["per_second"] == 400
    assert "| peer | 500 ms | 2 | 200 |" in render(summary)


def test_lines_with_different_work_have_no_ratio() -> None:
    """Stages are not compared with each other."""
    summary = summarise(
        measured(
            line("stages", "read", 0.01, figure="rate"), line("stages", OURS, 4.0, figure="rate")
        ),
        {},
        1.0,
    )
    assert [one["ratio"] for one in summary["groups"]["stages"]] == [None, None]
    assert "| read | 10 ms | 10,000 boxes |" in render(summary)


@pytest.mark.parametrize(
    ("timer", "shown"), [("process_time", "CPU time"), ("perf_counter", "by the clock")]
)
def test_a_table_explains_its_times(timer: str, shown: str) -> None:
    """CPU time and wall-clock time differ on a busy machine."""
    page = render(summarise(measured(line("NMS", OURS, 0.25, timer=timer)), {}, 1.0))
    assert f"| {shown} | times curate's |" in page


@pytest.mark.parametrize(("seconds", "verdict"), [(1e-3, "met"), (1.1e-3, "**not met**")])
def test_a_target_is_met_or_missed(seconds: float, verdict: str) -> None:
    """One that is missed by a tenth is missed."""
    page = render(summarise(measured(line("NMS", OURS, seconds, target=1e-3)), {}, 1.0))
    [row] = [row for row in page.splitlines() if "1 ms |" in row and row.startswith("| NMS")]
    assert row.split(" | ")[-1] == f"{verdict} |"
    assert f" {3000 * seconds:.3g} ms " in row


def test_only_the_kind_of_machine_is_published(tmp_path: Path) -> None:
    """No host, branch or folder is in the files."""
    source = tmp_path / "measured.json"
    source.write_text(json.dumps(measured(line("NMS", OURS, 0.25))))
    main(source, tmp_path)
    page = (tmp_path / "benchmarks.md").read_text()
    document = (tmp_path / "benchmarks.json").read_text()
    for text in (page, document):
        assert "secret" not in text
        assert "Some CPU" in text
    assert json.loads(document)["groups"]["NMS"][0]["seconds"] == 0.25


def test_a_benchmark_never_asserts_a_time() -> None:
    """Assertions compare results; times are only reported."""
    clocks = {"stats", "perf_counter", "monotonic", "elapsed"}
    for path in HERE.glob("bench_*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Assert):
                named = {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}
                named |= {n.attr for n in ast.walk(node) if isinstance(n, ast.Attribute)}
                assert not named & clocks, f"{path}:{node.lineno}"
