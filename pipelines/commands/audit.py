"""curate audit: compare pseudo-labels and their weights with ground truth."""

import math
import operator
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


FIGURES = {
    "auroc": "AUROC",
    "average_precision": "AP",
    "equal_recall_precision": "precision at equal recall",
    "calibration_error": "calibration error",
}
"""The figures by which policies are compared, with their names in tables."""

_WEIGHTS_PER_TABLE = 7  # as many fit into 80 columns


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
            help="Policy, or a single piece of evidence: score, rho_det, consistency or "
            "probability; repeatable. Default: pspsl, spsl, threshold, uniform, all evidence, and "
            "learned where there are probabilities."
        ),
    ] = None,
    overlap: Annotated[
        str, typer.Option(help="IoU that makes a label correct: bev or 3d.")
    ] = "bev",
    replicates: Annotated[
        int, typer.Option(min=10, help="Bootstrap samples for the confidence intervals.")
    ] = 1000,
    reference: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(
            help="Audited policy or evidence whose weighted recall the others are brought to. "
            "Default: run.method.",
        ),
    ] = None,
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
    fold. Policies are compared at equal weighted recall, each weight v as v^power. A difference
    "may be chance" if its interval over frames (or sequences, if there are any) contains 0. The
    chart is reports/audit-*.png. The tables audit, audit_slice (by distance and points), audit_bin
    (by weight) and audit_difference contain the numbers: curate query --named reliability

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
        reference=reference,
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
        f"{figures.resampled}\n"
    )
    whole = by_policy.values()
    print_table(
        ("weight of", "AUROC", "interval", "AP", "interval"),
        [
            (each.policy, *_with_interval(each.auroc), *_with_interval(each.average_precision))
            for each in whole
        ],
        title="ranking of the labels by weight",
    )
    print_table(
        ("weight of", "recall", "precision", "interval", "at equal recall", "interval"),
        [
            (
                each.policy,
                _shown(each.weighted_recall.value),
                *_with_interval(each.weighted_precision),
                *_with_interval(each.equal_recall_precision),
            )
            for each in whole
        ],
        title="share of the weight on correct labels, also with the weights raised to the power "
        f"that gives the weighted recall of {figures.reference}",
    )
    print_table(
        ("weight of", "error", "interval", "by chance", "limit", ""),
        [
            (
                each.policy,
                *_with_interval(each.calibration_error),
                _shown(each.calibration_error_by_chance),
                _shown(each.calibration_error_limit),
                _excess(each),
            )
            for each in whole
        ],
        title="calibration error, beside that of perfectly calibrated weights: mean, and "
        f"{100 * figures.level:.0f} % limit",
    )
    _print_differences(figures)
    _print_parts(figures)
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
                *(f"{each.difference.value:+.3f}", _bounds(each.difference)),
                "" if each.beyond_chance else "may be chance",
            )
            for each in found.fusion
        ],
        title="share of correct labels before and after fusion (repredict.fuse)",
    )


def _print_differences(figures: "Audit") -> None:
    """Print the differences of every weight to the reference, and which of them may be chance."""
    reference = figures.reference
    others = [name for name in figures.whole() if name != reference]
    if reference is None or not others:
        return
    compared = [figures.compare(name, reference) for name in others]
    rows = [
        (found.policy, label, f"{difference.value:+.3f}", _bounds(difference), verdict)
        for name, label in FIGURES.items()
        for found in compared
        if not math.isnan((difference := found.differences[name]).value)
        for verdict in ["real" if found.is_real(name) else "may be chance"]
    ]
    if not rows:
        return
    print_table(
        ("weight of", "figure", "difference", "interval", ""),
        rows,
        title=f"differences to {reference}; other pairs are in the table audit_difference",
    )


def _print_parts(figures: "Audit") -> None:
    """Print the figures by category, then by distance and points over all categories."""
    rows: dict[tuple[str, str], list[Figures]] = {}
    for each in figures.figures:
        if each.slice.by == "all" or each.category == "all":
            rows.setdefault((each.category, f"{each.slice.by} {each.slice}"), []).append(each)
    ordered = sorted(rows.items(), key=lambda row: row[0][1] != "all all")
    parts = {(of if part == "all all" else part): found for (of, part), found in ordered}
    print_table(
        ("part", "correct", "labels", "objects"),
        [
            (part, first.right, first.labels, "-" if first.objects is None else first.objects)
            for part, (first, *_) in parts.items()
        ],
        title="labels and objects by category, distance and points in the label",
    )
    columns = {name: operator.attrgetter(f"{name}.value") for name in FIGURES}
    by_chance = operator.attrgetter("calibration_error_by_chance")
    names = list(figures.whole())
    for title, value in (
        *((f"{FIGURES[name]} by part", value) for name, value in columns.items()),
        ("calibration error by chance by part", by_chance),
    ):
        for start in range(0, len(names), _WEIGHTS_PER_TABLE):
            shown = slice(start, start + _WEIGHTS_PER_TABLE)
            print_table(
                ("part", *names[shown]),
                [(part, *map(_shown, map(value, found[shown]))) for part, found in parts.items()],
                title=title,
            )


def _excess(found: "Figures") -> str:
    """Return whether the calibration error is larger than chance explains."""
    if math.isnan(found.calibration_error.value):
        return ""
    return "may be chance" if found.calibrated else "beyond chance"


def _with_interval(estimate: "Estimate") -> tuple[str, str]:
    return _shown(estimate.value), _interval(estimate)


def _interval(estimate: "Estimate") -> str:
    return "-" if math.isnan(estimate.low) else f"{estimate.low:.2f} - {estimate.high:.2f}"


def _bounds(difference: "Estimate") -> str:
    return f"[{difference.low:+.3f}, {difference.high:+.3f}]"


def _shown(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.3f}"
