"""Output of --dry-run."""

from typing import TYPE_CHECKING

from pipelines.reports.terminal import print_json, print_line

if TYPE_CHECKING:
    from collections.abc import Iterable

    from pipelines.engine.preview import PlannedStage


def print_preview(planned: "Iterable[PlannedStage]", *, as_json: bool) -> None:
    """Print what each stage would do and why, and the expected time of all."""
    from pipelines.engine.progress import duration

    stages = list(planned)
    measured = [stage.seconds for stage in stages if stage.seconds is not None]
    unknown = [stage.stage for stage in stages if stage.seconds is None]
    total = sum(measured)
    if as_json:
        print_json({"stages": stages, "seconds": total, "stages_without_a_rate": unknown})
        return
    for stage in stages:
        print_line(_line(stage), indent=4)
    if not any(stage.reasons for stage in stages):
        print_line("Everything is up to date.")
        return
    costs = [f"about {duration(total)}"] if any(stage.seconds for stage in stages) else []
    if unknown:
        names = ", ".join(dict.fromkeys(unknown))
        costs.append(f"an unknown time for {names}, which no earlier run has measured")
    print_line(f"Total: {', and '.join(costs)}. Nothing was done.")


def _line(stage: "PlannedStage") -> str:
    from pipelines.engine.progress import duration

    head = f"round {stage.round}  {stage.stage:<11} "
    if not stage.reasons:
        return f"{head}up to date"
    cost = "" if stage.seconds is None else f"; about {duration(stage.seconds)}"
    why = "; ".join(stage.reasons)
    if stage.frames is None:
        return f"{head}would run: {why}{cost}"
    names = ", ".join(stage.first_frames)
    more = ", ..." if stage.frames > len(stage.first_frames) else ""
    count = f"{stage.frames} frame{'' if stage.frames == 1 else 's'}"
    return f"{head}would work on {count} ({names}{more}): {why}{cost}"
