"""curate bench: run methods on the same data, and compare them in tables."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pipelines.commands.options import ChartFormatOption, JsonOption
from pipelines.reports.terminal import print_json, print_table

if TYPE_CHECKING:
    from pipelines.bench.report import BenchReport
    from pipelines.bench.settings import Bench

# The seven methods and the ratios of the paper. A cell of this size takes two cores ten minutes.
METHODS = "baseline,uda,uda-cl,sess,3dioumatch,spsl,pspsl"
RATIOS = "0.04,0.08,0.16,0.32,0.64"
SEEDS = "0,1,2"
FRAMES, VAL = 600, 300


def bench(
    directory: Annotated[Path, typer.Argument(help="Folder of the benchmark.")],
    data: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="synthetic, or the folder of a data set in KITTI's layout. Default: synthetic."
        ),
    ] = None,
    methods: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help=f"Comma-separated methods. Default: {METHODS}."),
    ] = None,
    ratios: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help=f"Comma-separated labeled shares of the training frames. Default: {RATIOS}."
        ),
    ] = None,
    seeds: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help=f"Comma-separated seeds of split, training and augmentation. Default: {SEEDS}."
        ),
    ] = None,
    frames: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=2, help=f"Number of training frames to simulate. Default: {FRAMES}."),
    ] = None,
    val: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help=f"Number of validation frames to simulate. Default: {VAL}."),
    ] = None,
    data_seed: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=0, help="Random seed of the simulation. Default: 0."),
    ] = None,
    steps: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Optimiser steps of each round. Default: 1200."),
    ] = None,
    teacher_steps: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Optimiser steps of the teacher. Default: those of --steps."),
    ] = None,
    rounds: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Number of rounds of every method. Default: 2."),
    ] = None,
    detector: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Detector to train, or one of its presets, such as voxel-rcnn-small "
            "(docs/detectors.md). Default: pillars."
        ),
    ] = None,
    override: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option("--set", help="Any setting of curate.toml, as section.key=value; repeatable."),
    ] = None,
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Number of jobs at once, one thread each; default: one per core."),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report", help="Run nothing; print the results of the finished cells.")
    ] = False,
    overlaps: Annotated[
        str,
        typer.Option(help="IoU thresholds of the tables to print: kitti, loose (relaxed) or all."),
    ] = "kitti",
    image_format: ChartFormatOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare methods over labeled shares and seeds, on simulated data or on yours.

    Every cell of the grid (method, share, seed) is a workspace in the folder cells of DIRECTORY.
    All methods start from the same teacher and take the same number of optimiser steps. Finished
    cells are kept, and the same command resumes after an interruption. Options that you leave out
    keep their value from the previous run. More methods, shares and seeds can be added later; all
    other options are fixed by the first run. Ablations: --set train.zero_weight=background, --set
    solve.scope=frame.

    Prints tables (AP R40, recall, labels) and writes results.md, results.json and curve.png.
    On KITTI: --data KITTI --set segmenter.name=onnx --set segmenter.path=deeplab.onnx --set
    segmenter.classes=voc.

    Example: curate bench bench --methods baseline,pspsl --ratios 0.08 --seeds 0 --steps 300
    """
    from curate.errors import CellsFailed, ConfigError
    from curate.viewing.chart_style import check_format
    from pipelines.bench.report import BenchReport

    kind = check_format(image_format or "png")
    if overlaps not in {"kitti", "loose", "all"}:
        raise ConfigError(f"--overlaps {overlaps}: use kitti, loose or all")
    overrides = [*_detector_settings(detector), *map(_absolute, override or ())]
    requested = {
        "data": data,
        "frames": frames,
        "val": val,
        "data_seed": data_seed,
        "steps": steps,
        "teacher_steps": teacher_steps,
        "rounds": rounds,
        "overrides": tuple(overrides) or None,
    }
    grid = {"methods": methods, "ratios": ratios, "seeds": seeds}
    chosen = _open(directory) if report else _choose(directory, requested, grid)
    try:
        if not report:
            _run(chosen, workers or os.cpu_count() or 1, quiet=as_json)
    except CellsFailed:
        _announce(BenchReport(chosen, kind), overlaps, as_json=as_json)
        raise
    _announce(BenchReport(chosen, kind), overlaps, as_json=as_json)


def bench_cell(
    directory: Annotated[Path, typer.Argument()],
    ratio: Annotated[float, typer.Option()],
    seed: Annotated[int, typer.Option()],
    method: Annotated[Optional[str], typer.Option()] = None,  # noqa: UP045
) -> None:
    """Run one job of a bench and report its progress to the parent process; end with it."""
    from pipelines.bench.cell import run_job
    from pipelines.bench.grid import Job
    from pipelines.bench.metered import Metered
    from pipelines.bench.processes import end_with_parent

    end_with_parent()
    run_job(_open(directory), Job(ratio, seed, method), Metered(sys.stdout))


def _open(directory: Path) -> "Bench":
    """Return the bench in a folder."""
    from curate.errors import WorkspaceError
    from pipelines.bench.settings import read_bench

    found = read_bench(directory)
    if found is None:
        raise WorkspaceError(f"{directory}: no benchmark here; start one with `curate bench DIR`")
    return found


def _choose(directory: Path, requested: dict[str, Any], grid: dict[str, str | None]) -> "Bench":
    """Return the requested bench; other settings are those of the previous run, or the defaults."""
    from curate.errors import ConfigError
    from pipelines.bench.settings import SYNTHETIC, Bench, BenchSettings, check_axes, read_bench

    stored = read_bench(directory)
    given = {name: value for name, value in requested.items() if value is not None}
    if stored is not None:
        given = {**stored.settings.model_dump(), **given}
    if given.get("data", SYNTHETIC) == SYNTHETIC:
        given = {"frames": FRAMES, "val": VAL, "data_seed": 0, **given}
    else:
        for name in ("frames", "val", "data_seed"):
            if requested[name] is not None:
                option = name.replace("_", "-")
                raise ConfigError(f"--{option}: only for simulated data; leave it out with --data")
        given["data"] = str(Path(given["data"]).resolve())
        if not Path(given["data"]).is_dir():
            raise ConfigError(f"--data {given['data']}: no such folder; give a folder or synthetic")
    axes = check_axes(_axes(grid, stored))
    chosen = Bench(directory.resolve(), BenchSettings(**given), axes)
    for method in axes.methods:
        chosen.config(axes.seeds[0], method)
    return chosen


def _detector_settings(detector: str | None) -> list[str]:
    """Return the settings of a detector or preset."""
    from pipelines.registry import detector_and_preset

    if detector is None:
        return []
    name, preset = detector_and_preset(detector)
    return [f"detector.name={name}", *([] if preset is None else [f"train.preset={preset}"])]


def _absolute(override: str) -> str:
    """Return an override with an absolute path, so that the bench can resume in any folder."""
    key, _, value = override.partition("=")
    return f"{key}={Path(value).resolve()}" if key.endswith(".path") else override


def _axes(grid: dict[str, str | None], stored: "Bench | None") -> Any:
    """Return the axes of the grid from the options of the command line."""
    from curate.errors import ConfigError
    from pipelines.bench.settings import Axes
    from pipelines.stages.methods import METHODS as ALL_METHODS

    paper = ",".join(name for name in METHODS.split(",") if name in ALL_METHODS)
    axes: dict[str, Any] = {}
    for name, default, kind in (
        ("methods", paper, str), ("ratios", RATIOS, float), ("seeds", SEEDS, int),
    ):  # fmt: skip
        text = grid[name]
        if text is None and stored is not None:
            axes[name] = getattr(stored.axes, name)
            continue
        items = (default if text is None else text).split(",")
        try:
            axes[name] = tuple(kind(item.strip()) for item in items if item.strip())
        except ValueError as error:
            raise ConfigError(f"--{name} {text}: give numbers separated by commas") from error
    return Axes(**axes)


def _run(bench: "Bench", workers: int, *, quiet: bool) -> None:
    """Simulate the data if needed, and run the grid; `quiet` sends messages to stderr."""
    from pipelines.bench.data import make_data
    from pipelines.bench.processes import JobProcesses
    from pipelines.bench.running import alone, run_grid
    from pipelines.bench.settings import claim
    from pipelines.engine.progress import Bar

    def say(line: str) -> None:
        typer.echo(line, err=quiet)

    with alone(bench.root):
        claim(bench)
        make_data(bench, workers, say, Bar())
        run_grid(bench, JobProcesses(bench.root), workers, say, Bar())


def _announce(report: "BenchReport", overlaps: str, *, as_json: bool) -> None:
    """Write the result files and print the tables."""
    from pipelines.bench.report import shown

    if not report.results:
        typer.echo("no cell is finished yet", err=True)
        if as_json:
            print_json({})
        return
    written = report.write()
    if as_json:
        print_json(report.numbers())
        return
    for table in report.tables:
        if overlaps == "all" or table.overlaps in {None, overlaps}:
            rows = [[shown(value) for value in row] for row in table.rows]
            print_table(table.columns, rows, title=table.title)
    typer.echo("\n".join(str(path) for path in written))
