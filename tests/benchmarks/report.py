"""Create docs/benchmarks.json and docs/benchmarks.md from the output of pytest-benchmark.

Usage: python report.py MEASURED.json FOLDER
"""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

OURS = "curate"
CPU_TIMERS = {"process_time", "cpu_seconds_of_children"}
PACKAGES = ("numpy", "numba", "torch", "open3d-cpu", "open3d", "shapely", "opencv-python-headless")

_HEAD = """# Benchmarks

Written by `make bench`; do not edit. {cpu}, {cores} cores, one thread, Python {python};
{packages}.

Times are the best of several rounds in one run. Times depend on the machine; ratios hold better.
All lines of a table with ratios do the same work on the same data, and their answers are compared.
What a peer needs in a form of its own is made outside the measured time. CPU time is what the clock
shows on a quiet core; while this was measured, {load:.1f} processes wanted the {cores} cores.
"""


def summarise(
    measured: Mapping[str, Any], versions: Mapping[str, str], load: float
) -> dict[str, Any]:
    """Return the figures of a run, without names of the machine or its folders.

    Args:
        measured: the JSON document of pytest-benchmark.
        versions: of the packages that were used.
        load: load average, this process included.
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for benchmark in measured["benchmarks"]:
        groups.setdefault(benchmark["group"], []).append(_line(benchmark))
    cpu = measured["machine_info"]["cpu"]
    return {
        "machine": {
            "cpu": cpu.get("brand_raw", "unknown processor"),
            "cores": cpu.get("count"),
            "python": measured["machine_info"]["python_version"],
            "load": load,
            "packages": dict(versions),
        },
        "groups": {name: _with_ratios(lines) for name, lines in groups.items()},
    }


def render(summary: Mapping[str, Any]) -> str:
    """Return the page: the targets first, then a table per group."""
    machine = summary["machine"]
    packages = ", ".join(f"{name} {number}" for name, number in machine["packages"].items())
    parts = [_HEAD.format(**{**machine, "packages": packages}), _targets(summary["groups"])]
    parts += [_table(name, lines) for name, lines in summary["groups"].items()]
    return "\n".join(parts)


def _line(benchmark: Mapping[str, Any]) -> dict[str, Any]:
    info, stats = benchmark["extra_info"], benchmark["stats"]
    target = info["target_s"]
    by_cpu = benchmark["options"]["timer"] in CPU_TIMERS
    return {
        "name": info["name"],
        "figure": info["figure"],
        "timer": "CPU" if by_cpu else "clock",
        "seconds": stats["min"],
        "median_seconds": stats["median"],
        "clock_seconds": info["clock_s"],
        "rounds": stats["rounds"],
        "per_second": info["amount"] / stats["min"],
        "unit": info["unit"],
        "target_seconds": target,
        "met": None if target is None else stats["min"] <= target,
    }


def _with_ratios(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return each line with its time as a multiple of ours, if the lines do the same work."""
    ours = next((line["seconds"] for line in lines if line["name"] == OURS), None)
    return [
        {**line, "ratio": line["seconds"] / ours if ours and line["figure"] == "ratio" else None}
        for line in lines
    ]


def _targets(groups: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    rows = [
        (
            name if line["name"] == OURS else f"{name}: {line['name']}",
            _time(line["seconds"]),
            _time(line["clock_seconds"]),
            _time(line["target_seconds"]),
            "met" if line["met"] else "**not met**",
        )
        for name, lines in groups.items()
        for line in lines
        if line["target_seconds"] is not None
    ]
    return _markdown("Targets", ("what", "CPU time", "by the clock", "at most", ""), rows)


def _table(name: str, lines: Sequence[Mapping[str, Any]]) -> str:
    first = lines[0]
    best = "CPU time" if first["timer"] == "CPU" else "by the clock"
    if first["figure"] == "ratio":
        lines = sorted(lines, key=lambda line: line["seconds"])
        columns = ["", best, "times curate's", f"{first['unit']}/s"]
    else:
        columns = ["", best, "per second"] if first["figure"] == "rate" else ["", best]
    return _markdown(name, columns, [_row(line) for line in lines])


def _row(line: Mapping[str, Any]) -> list[str]:
    row = [line["name"], _time(line["seconds"])]
    if line["figure"] == "ratio":
        ratio = "" if line["ratio"] is None else _number(line["ratio"])
        return [*row, ratio, _number(line["per_second"])]
    if line["figure"] == "rate":
        return [*row, f"{_number(line['per_second'])} {line['unit']}"]
    return row


def _markdown(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    rule = ["---", *["---:"] * (len(columns) - 1)]
    table = "\n".join(f"| {' | '.join(row)} |" for row in (columns, rule, *rows))
    return f"## {title}\n\n{table}\n"


def _time(seconds: float) -> str:
    return f"{_number(seconds)} s" if seconds >= 1 else f"{_number(seconds * 1000)} ms"


def _number(value: float) -> str:
    """Return three significant digits with thousands separators."""
    if value >= 100:
        return f"{float(f'{value:.3g}'):,.0f}"
    return f"{value:.3g}"


def _versions() -> dict[str, str]:
    """Return the versions of the installed packages."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def main(measured: Path, folder: Path) -> None:
    """Write both files."""
    summary = summarise(
        json.loads(measured.read_text(encoding="utf-8")), _versions(), os.getloadavg()[1]
    )
    document = json.dumps(summary, indent=2) + "\n"
    (folder / "benchmarks.json").write_text(document, encoding="utf-8")
    (folder / "benchmarks.md").write_text(render(summary), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
