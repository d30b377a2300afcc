"""The report of a bench: tables, results.md, results.json and a chart."""

import json
import math
import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from curate.evaluation.comparison import PairedDifference
from curate.evaluation.object_statistics import QUANTILES, object_statistics
from curate.files.atomic import replace_file
from curate.viewing.chart_style import Chart, ImageFormat
from curate.viewing.charts import Curve, CurvePanel, curves_chart
from pipelines.assessment.evaluation import kitti_objects
from pipelines.bench.results import OVERLAPS, JobResult, read_results
from pipelines.bench.settings import SYNTHETIC, Bench
from pipelines.bench.tables import Entry, Finished, Table, Value, all_tables, signed
from pipelines.bench.truth import BENCH_METHODS
from pipelines.workspace.workspace import open_dataset, read_truth

MARKDOWN, NUMBERS = "results.md", "results.json"


@dataclass(frozen=True)
class BenchReport:
    """The report of the finished jobs of a bench.

    Attributes:
        bench: see `Bench`.
        image_format: format of the chart.
    """

    bench: Bench
    image_format: ImageFormat = "png"

    @cached_property
    def results(self) -> list[JobResult]:
        """The results of all finished jobs."""
        return read_results(self.bench.root)

    @cached_property
    def finished(self) -> Finished:
        """The results by method, ratio and seed."""
        return Finished(self.results)

    @cached_property
    def tables(self) -> list[Table]:
        """All tables; the first describes the objects of the data set."""
        return [*self._object_tables(), *all_tables(self.finished)]

    def write(self) -> list[Path]:
        """Write results.md, results.json and, if a cell is finished, the chart."""
        root = self.bench.root
        replace_file(root / MARKDOWN, self.markdown().encode())
        replace_file(root / NUMBERS, (json.dumps(self.numbers(), indent=1) + "\n").encode())
        written = [root / MARKDOWN, root / NUMBERS]
        if self.finished.methods:
            self.chart().save(root / self._chart_name)
            written.append(root / self._chart_name)
        return written

    def numbers(self) -> dict[str, Any]:
        """Return all results as plain numbers for JSON."""
        return {
            "settings": self.bench.settings.model_dump(mode="json"),
            "grid": self.bench.axes.model_dump(mode="json"),
            "conditions": list(self.conditions()),
            "tables": [
                {
                    "title": table.title,
                    "overlaps": table.overlaps,
                    "columns": [name.replace("\n", " ") for name in table.columns],
                    "rows": [[_plain(value) for value in row] for row in table.rows],
                }
                for table in self.tables
            ],
            "jobs": [result.model_dump(mode="json") for result in self.results],
        }

    def markdown(self) -> str:
        """Return the content of results.md."""
        lines = ["# Comparison of the methods by `curate bench`", ""]
        lines += [f"- {condition}" for condition in self.conditions()]
        if self.finished.methods:
            lines += ["", f"![Mean AP over labeled ratio]({self._chart_name})"]
        for table in self.tables:
            lines += ["", f"## {table.title[0].upper()}{table.title[1:]}", ""]
            names = [name.replace("\n", " ") for name in table.columns]
            lines.append("| " + " | ".join(names) + " |")
            lines.append("|---" + "|---:" * (len(table.columns) - 1) + "|")
            lines += [
                "| " + " | ".join(shown(v, full=True) for v in row) + " |" for row in table.rows
            ]
        return "\n".join([*lines, ""])

    def conditions(self) -> Iterator[str]:
        """Yield the conditions of the experiments, one sentence each."""
        settings, finished = self.bench.settings, self.finished
        yield f"command: `{command(self.bench)}`"
        cells = sum(result.method is not None for result in self.results)
        yield f"{cells} finished cells: {len(finished.methods)} methods, seeds " + ", ".join(
            map(str, finished.seeds)
        )
        for name in finished.methods:
            if name in BENCH_METHODS:
                yield f"`{name}`: {BENCH_METHODS[name].note}"
        yield (
            f"equal optimiser steps: every method trains {settings.rounds} x {settings.steps} "
            "steps from the same teacher, which is trained for "
            f"{settings.teacher_steps or settings.steps} steps on X_l; batches, augmentation and "
            "learning rates are the same"
        )
        yield (
            "the seed determines the labeled frames (those of a ratio include those of smaller "
            "ratios), the training and the augmented views; all cells share one data set and its "
            "val frames"
        )
        yield (
            "KITTI AP, 40 recall positions, in percent; mean is over categories and difficulties; "
            "± is the standard deviation over n seeds, (+) the gain over the baseline"
        )
        missing = finished.without_objects("kitti", "3d")
        if missing:
            yield f"-, and not in any mean, because no object counts: {', '.join(missing)}"
        yield "the student of the last round is evaluated on val; val is not used to select models"
        for about in {tuple(sorted(result.about.items())) for result in self.results}:
            versions = dict(about)
            yield (
                f"curate {versions['curate']}, torch {versions['torch']}, {versions['device']}, "
                f"Python {platform.python_version()}, {platform.machine()}"
            )
        failed = sum(result.failed_frames for result in self.results)
        if failed:
            yield f"{failed} results of single frames failed and are not included"

    @property
    def _chart_name(self) -> str:
        return f"curve.{self.image_format}"

    def chart(self) -> Chart:
        """Return mean 3D AP over the labeled ratio, at KITTI's and the relaxed IoU thresholds."""
        panels = []
        for overlaps in OVERLAPS:
            values = {
                method: np.array(
                    [
                        [entry.spread.mean, entry.spread.std]
                        for entry in row[1:]
                        if isinstance(entry, Entry)
                    ]
                )
                for method, *row in ((r[0], *r) for r in self._summary(overlaps).rows)
            }
            curves = [Curve(str(name), *columns.T) for name, columns in values.items()]
            title = self._summary(overlaps).title
            panels.append(CurvePanel(title, np.array(self.finished.ratios), curves))
        note = (
            "dot: mean over seeds; bar: standard deviation; legend: AP at the end of the line; "
            "AP R40, mean over categories and difficulties; teacher: trained on X_l once; "
            "baseline: trained on X_l for as many steps as the other methods"
        )
        return curves_chart(panels, "AP over labeled ratio", note)

    def _summary(self, overlaps: str) -> Table:
        return next(
            table
            for table in self.tables
            if table.overlaps == overlaps and table.title.startswith("mean 3D AP, IoU")
        )

    def _object_tables(self) -> Iterator[Table]:
        """Yield the table of the objects in the val frames, by difficulty."""
        config = self.bench.config(0)
        if not (self.bench.data / "ImageSets" / "val.txt").is_file():
            return
        dataset = open_dataset(config)
        names = dataset.splits()["val"]
        frames = [
            kitti_objects(
                read_truth(config, dataset, name), dataset.read(name, points=False)
            ).objects
            for name in names
        ]
        rows: list[tuple[Value, ...]] = []
        for category, found in object_statistics(frames, config.dataset.categories).items():
            shares = (found.occluded, found.mostly_occluded, found.truncated)
            rows.append(
                (
                    *(category, found.objects, f"{found.per_frame:.2f}"),
                    *(f"{number:.2f}" for number in found.counted),
                    *("-" if math.isnan(share) else f"{100 * share:.0f} %" for share in shares),
                    " / ".join(f"{distance:.0f}" for distance in found.distances)
                    if found.objects
                    else "-",
                )
            )
        quantiles = "/".join(f"{100 * share:.0f}" for share in QUANTILES)
        yield Table(
            f"difficulty of the data: objects of the {len(names)} val frames",
            (
                *("category", "objects", "per\nframe", "count at\neasy", "at\nmod.", "at\nhard"),
                *("occluded", "mostly\noccluded", "truncated\n> 15 %"),
                f"metres, quantiles\n{quantiles} %",
            ),
            tuple(rows),
        )


def command(bench: Bench) -> str:
    """Return the command that reproduces the bench in the folder DIR."""
    settings, axes = bench.settings, bench.axes
    words = ["curate bench DIR", f"--data {settings.data}"]
    if settings.data == SYNTHETIC:
        words.append(
            f"--frames {settings.frames} --val {settings.val} --data-seed {settings.data_seed}"
        )
    words.append(f"--methods {','.join(axes.methods)}")
    words.append(f"--ratios {','.join(f'{ratio:g}' for ratio in axes.ratios)}")
    words.append(f"--seeds {','.join(map(str, axes.seeds))}")
    words.append(f"--steps {settings.steps} --rounds {settings.rounds}")
    if settings.teacher_steps is not None:
        words.append(f"--teacher-steps {settings.teacher_steps}")
    words += [f"--set {override}" for override in settings.overrides]
    return " ".join(words)


def shown(value: Value, *, full: bool = False) -> str:
    """Return a value as text for a table; `full` adds the gain."""
    if isinstance(value, Entry):
        return value.full if full else value.short
    if isinstance(value, PairedDifference):
        if math.isnan(value.mean):
            return "-"
        ends = f" [{signed(value.low)}, {signed(value.high)}]"
        return signed(value.mean) + ("" if math.isnan(value.low) else ends)
    return str(value)


def _plain(value: Value) -> Any:
    """Return a value for JSON, with None instead of NaN."""
    if isinstance(value, Entry):
        return {**_finite(asdict(value.spread)), **_finite({"gain": value.gain})}
    if isinstance(value, PairedDifference):
        return _finite(asdict(value))
    return value


def _finite(numbers: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: None if isinstance(number, float) and math.isnan(number) else number
        for name, number in numbers.items()
    }
