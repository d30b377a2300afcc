"""curate audit: compare pseudo-labels and their weights with ground truth."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

from pipelines.commands.options import (
    ChartFormatOption,
    ExecutorOption,
    JsonOption,
    ProcessesOption,
    RoundOption,
    ThreadsOption,
    WorkersOption,
    WorkspaceOption,
    end,
    open_workspace,
)
from pipelines.reports.terminal import print_json, print_line, print_report, print_table

if TYPE_CHECKING:
    from collections.abc import Mapping

    from curate.evaluation.audit import Audit, Estimate, Figures
    from pipelines.assessment.audit import AuditedRound


def audit(
    split: Annotated[
        str,
        typer.Option(
            help="Frames to audit: val, or labeled for a detector that was not trained on them."
        ),
    ] = "val",
    folds: Annotated[
        int,
        typer.Option(
            min=0, help="Audit this many held-out folds of the labeled frames instead; 0: none."
        ),
    ] = 0,
    policy: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            help="Policy, or a single piece of evidence: score, rho_det or consistency; "
            "repeatable. Default: pspsl, spsl, threshold, uniform, and all three."
        ),
    ] = None,
    overlap: Annotated[
        str, typer.Option(help="IoU that makes a label correct: bev or 3d.")
    ] = "bev",
    replicates: Annotated[
        int, typer.Option(min=10, help="Bootstrap samples for the confidence intervals.")
    ] = 1000,
    round_number: RoundOption = None,
    executor: ExecutorOption = None,
    workers: WorkersOption = None,
    processes: ProcessesOption = None,
    threads: ThreadsOption = None,
    image_format: ChartFormatOption = None,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure how many pseudo-labels are correct and how well each policy's weights rank them.

    Frames with ground truth that the teacher was not trained on are treated as unlabeled, and their
    labels are then compared with the ground truth. A label is correct with an IoU above 0.7 (Car),
    0.5 (others) or evaluation.overlaps. With --folds K, K teachers are each trained without one
    fold. The chart is reports/audit-*.png. The tables audit, audit_slice (by distance and points)
    and audit_bin (by weight) contain the numbers: curate query "SELECT policy, category, auroc,
    auroc_low, auroc_high FROM audit"

    Example: curate audit --policy pspsl --policy threshold --policy score
    """
    from dataclasses import asdict
    from typing import cast, get_args

    from curate.errors import ConfigError
    from curate.evaluation.audit_summary import as_numbers, as_plain
    from curate.evaluation.reliability import Overlap
    from curate.viewing.chart_style import check_format
    from curate.viewing.charts import audit_chart
    from pipelines.assessment.audit import AuditRequest, describe_audit, picture_path, run_audit
    from pipelines.assessment.store import store_audit
    from pipelines.category_names import check_names
    from pipelines.engine.progress import Bar
    from pipelines.labels.matching import configured_overlaps

    kind = check_format(image_format or "png")
    if overlap not in get_args(Overlap):
        raise ConfigError(f"--overlap {overlap}: use bev or 3d")
    options: dict[str, Any] = {"names": tuple(dict.fromkeys(policy))} if policy else {}
    request = AuditRequest(
        split,
        folds,
        round_number,
        overlap=cast("Overlap", overlap),
        replicates=replicates,
        **options,
    )
    opened = open_workspace(workspace, executor, workers, threads, processes)
    check_names(opened)
    found = run_audit(opened, request, Bar(), (lambda _: None) if as_json else print_report)
    store_audit(opened, found)
    picture = picture_path(opened, found, kind)
    audit_chart(found.figures, _title(found)).save(picture)
    summary = describe_audit(found)
    if as_json:
        header = {
            "round": found.context.number,
            "rounds": found.context.rounds,
            "audited": request.frames,
            "overlap": overlap,
            "thresholds": configured_overlaps(opened.config),
            "unmeasured": list(found.unmeasured),
            "summary": summary,
            "picture": str(picture),
        }
        if found.fusion:
            header["fusion"] = as_plain([asdict(each) for each in found.fusion])
        print_json({**header, **as_numbers(found.figures)})
    else:
        _print(found.figures, _title(found), configured_overlaps(opened.config))
        print_fusion(found)
        print_line("\n".join(summary), indent=2)
        print_line(f"picture: {picture}")
    end(found.reports, as_json=False)


def _title(found: "AuditedRound") -> str:
    request, context = found.request, found.context
    kind = "BEV" if request.overlap == "bev" else "3D"
    return (
        f"audit of round {context.number} of {context.rounds} on {request.frames}, "
        f"correct by {kind} overlap"
    )


def _print(figures: "Audit", title: str, overlaps: "Mapping[str, float]") -> None:
    """Print all policies, their AUROC by slice, and the weight bins of the first one."""
    from pipelines.reports.count_table import print_counts

    by_policy = figures.whole()
    thresholds = ", ".join(f"{name} {overlap:g}" for name, overlap in overlaps.items())
    print_line(
        f"{title} (IoU above: {thresholds}); {100 * figures.level:.0f} % intervals over "
        f"{figures.frames} frames\n"
    )
    print_table(
        ("weight of", "AUROC", "interval", "AP", "precision", "interval", "recall", "calib. error"),
        [
            (
                each.policy,
                *(_shown(each.auroc.value), _interval(each.auroc)),
                _shown(each.average_precision.value),
                *(_shown(each.weighted_precision.value), _interval(each.weighted_precision)),
                *(_shown(each.weighted_recall.value), _shown(each.calibration_error.value)),
            )
            for each in by_policy.values()
        ],
        title="ranking of labels by weight, and share of the weight on correct labels",
    )
    print_table(
        ("part", "correct", "labels", "objects", *by_policy),
        _parts(figures),
        title="AUROC by category, distance and points in the label",
    )
    first = next(iter(by_policy.values()))
    print_counts({"objects": figures.counts, "labels": figures.label_counts})
    print_line("every object of a category counts, whatever its 2D box, occlusion or truncation")
    print_line("\n")
    print_table(
        ("weight", "labels", "precision", "recall"),
        [
            (f"{low:.1f}-{high:.1f}", labels, _shown(precision), _shown(recall))
            for low, high, labels, precision, recall in zip(
                *(first.bins.edges[:-1], first.bins.edges[1:], first.bins.labels),
                *(first.bins.precision, first.bins.recall),
                strict=True,
            )
            if labels
        ],
        title=f"labels by weight of {first.policy}; the other policies are in the table audit_bin",
    )


def print_fusion(found: "AuditedRound") -> None:
    """Print the share of correct labels before and after fusion, if boxes are fused."""
    if not found.fusion:
        return
    print_line("\n")
    print_table(
        ("overlap", "category", "labels", "before", "after", "difference", "interval", ""),
        [
            (
                *(each.overlap, each.category, each.labels),
                *(_shown(each.before.value), _shown(each.after.value)),
                *(_shown(each.difference.value), _interval(each.difference)),
                "" if each.beyond_chance else "may be chance",
            )
            for each in found.fusion
        ],
        title="share of correct labels before and after fusion (repredict.fuse)",
    )


def _parts(figures: "Audit") -> Iterator[tuple[Any, ...]]:
    """Yield a row per category, then one per distance and point count over all categories."""
    rows: dict[tuple[str, str], list[Figures]] = {}
    for each in figures.figures:
        if each.slice.by == "all" or each.category == "all":
            rows.setdefault((each.category, f"{each.slice.by} {each.slice}"), []).append(each)
    for (category, part), policies in sorted(rows.items(), key=lambda row: row[0][1] != "all all"):
        first = policies[0]
        name = category if part == "all all" else part
        yield (
            name,
            first.right,
            first.labels,
            "-" if first.objects is None else first.objects,
            *(_shown(each.auroc.value) for each in policies),
        )


def _interval(estimate: "Estimate") -> str:
    return "-" if math.isnan(estimate.low) else f"{estimate.low:.2f} - {estimate.high:.2f}"


def _shown(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"
