"""The output of `curate evaluate`: AP, what counts, and a warning if nothing does."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import typer

from curate.spelling import letters
from pipelines.reports.count_table import print_counts, short_level
from pipelines.reports.terminal import print_json, print_line, print_table, terminal_width

if TYPE_CHECKING:
    from curate.evaluation.difficulties import Difficulty
    from curate.evaluation.kitti_ap import KittiEvaluation


@dataclass(frozen=True)
class EvaluationReport:
    """An evaluation, with sentences about it.

    Attributes:
        figures: the evaluation.
        source: what was evaluated.
        notes: sentences about it.
        remedy: what to do if nothing counts because there are no 2D boxes.
    """

    figures: "KittiEvaluation"
    source: str
    notes: tuple[str, ...]
    remedy: str


def print_evaluation(found: EvaluationReport, *, as_json: bool) -> None:
    """Print the figures, what counts, and a warning if nothing does."""
    figures = found.figures
    warnings = _warnings(found)
    if as_json:
        print_json({**figures.as_dict(), "notes": [*found.notes, *warnings]})
        for warning in warnings:
            typer.echo(f"warning: {warning}", err=True)
        return
    print_line(found.source)
    for note in found.notes:
        print_line(note, indent=2)
    overlaps = ", ".join(f"{name} {overlap:g}" for name, overlap in figures.min_overlaps.items())
    print_line(f"IoU above: {overlaps}", indent=2)
    _print_figures(figures.as_dict())
    print_counts({"objects": figures.counts, "results": figures.result_counts})
    print_line(_limits(figures.difficulty), indent=2)
    for warning in warnings:
        print_line(warning, indent=2)


def _limits(difficulty: "Difficulty") -> str:
    """Return the levels with their limits."""
    pairs = zip(difficulty.levels, difficulty.limits(), strict=True)
    return "; ".join(f"{level}: {limit}" for level, limit in pairs)


def _warnings(found: EvaluationReport) -> list[str]:
    """Return sentences on sides of which nothing counts, and on names in other letters."""
    figures = found.figures
    sides = {"objects": figures.counts, "results": figures.result_counts}
    names = ", ".join(figures.min_overlaps)
    warnings = []
    for side, counts in sides.items():
        evaluated = sum(each.total for each in counts.categories)
        if evaluated and not counts.counted:
            reasons = ", ".join(f"{count} {reason}" for reason, count in counts.reasons().items())
            warnings.append(
                f"None of the {evaluated} {side} of {names} counts: {reasons}; "
                f"{_remedy(next(iter(counts.reasons())), found)}"
            )
        elif not evaluated and counts.not_evaluated:
            others = ", ".join(f"{n} {name}" for name, n in counts.not_evaluated.items())
            warnings.append(
                f"There are no {side} of {names}, but {others}; evaluate other categories with "
                "--categories (in a workspace: dataset.categories)"
            )
        elif not evaluated:
            warnings.append(f"There are no {side} of {names}")
        alike = _in_other_letters(counts.not_evaluated, figures.min_overlaps)
        warnings += [
            f"The {side} have {number} {name}, which is not {category}: they do not count; write "
            "the names alike"
            for name, number, category in alike
        ]
    return warnings


def _in_other_letters(
    others: Mapping[str, int], evaluated: Iterable[str]
) -> list[tuple[str, int, str]]:
    """Return name, number and category of each name that differs from one in its letters only."""
    of_letters = {letters(category): category for category in evaluated}
    return [
        (name, number, of_letters[letters(name)])
        for name, number in others.items()
        if letters(name) in of_letters
    ]


def _remedy(reason: str, found: EvaluationReport) -> str:
    """Return what to do about the most frequent reason."""
    if reason == "no 2D box":
        return found.remedy
    if reason == "outside the image":
        return "check the calibration, or use --difficulty distance"
    if reason == "no points":
        return "check that boxes and points have the same frame of reference (curate doctor)"
    if reason == "few points":
        return "lower --minimum-points"
    return "--difficulty points or distance does not depend on the image"


def _print_figures(figures: dict[str, Any]) -> None:
    """Print R40 and R11 side by side if they fit, a row per category and figure."""
    levels = [short_level(level) for level in figures["difficulties"]]
    kinds = (("R40", "R11"),) if len(levels) <= 3 else (("R40",), ("R11",))
    gap = "\n" if terminal_width() else " "
    for shown in kinds:
        columns = ["category", "figure", *(f"{kind}{gap}{d}" for kind in shown for d in levels)]
        rows = []
        for category in figures["objects"]:
            for figure in figures["AP_R40"][category]:
                values = [figures[f"AP_{kind}"][category][figure] for kind in shown]
                cells = [cell for each in values for cell in each or [None] * len(levels)]
                rows.append((category, figure, *map(_percent, cells)))
            if "R40" in shown:
                blank = [""] * len(levels) * (len(shown) - 1)
                rows += [
                    (category, f"recall 3d > {overlap}", *map(_percent, shares), *blank)
                    for overlap, shares in figures["recall_3d"][category].items()
                ]
        print_table(columns, rows, title="AP in percent")


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
