"""curate review: labels to an editor and back."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from pipelines.commands.options import JsonOption, PolicyOption, WorkspaceOption, open_workspace
from pipelines.reports.terminal import print_json, print_table

if TYPE_CHECKING:
    from pipelines.review.importing import ReviewImport

group = typer.Typer(
    name="review",
    help="Have people correct labels: what they decide wins over any policy.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
_COLUMNS = (
    "review", "round", "policy", "format", "frames", "boxes", "asked", "exported", "imported",
    "accepted", "rejected", "moved", "added",
)  # fmt: skip


@group.command("export")
def export_review(
    directory: Annotated[Path, typer.Argument(help="Folder to write; it must not be there yet.")],
    round_number: Annotated[
        Optional[int],  # noqa: UP045 - typer reads this form on every Python
        typer.Option("--round", min=1, help="Round; default: the last that was weighted."),
    ] = None,
    policy: PolicyOption = None,
    count: Annotated[int, typer.Option(min=1, help="On how many labels to ask.")] = 100,
    order: Annotated[
        str, typer.Option("--by", help="Which first: uncertain, lowest or changed.")
    ] = "uncertain",
    frames: Annotated[
        str, typer.Option(help="Only these, comma-separated; shown even without labels.")
    ] = "",
    category: Annotated[str, typer.Option(help="Only these, comma-separated.")] = "",
    form: Annotated[str, typer.Option("--format", help="kitti, labelcloud or cvat.")] = "kitti",
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Hand the least certain labels to an editor, with pictures of their whole frames.

    Uncertain: weight nearest to 0.5; lowest: lowest weight, of equal ones the highest score;
    changed: largest change since the round before. The other labels of these frames
    from a weight of 0.1 on are shown as context, and may be corrected as well; docs/review.md goes
    through an example.

    Example: curate review export to-review --count 50 --category Pedestrian,Cyclist
    """
    from pipelines.engine.progress import Bar
    from pipelines.registry import EDITORS
    from pipelines.review.exporting import write_review
    from pipelines.review.selection import ReviewRequest, make_sheet

    editor = EDITORS.build(form, offered={}, options={})
    opened = open_workspace(workspace)
    request = ReviewRequest(count, order, _names(frames), _names(category))
    chosen = policy or opened.config.run.method
    sheet = make_sheet(opened, round_number, chosen, form, request)
    write_review(opened, directory, sheet, editor, Bar())
    if as_json:
        print_json(
            {
                "review": sheet.id,
                "folder": str(directory),
                "round": sheet.round,
                "policy": sheet.policy,
                "frames": [frame.frame for frame in sheet.frames],
                "boxes": sheet.boxes,
                "asked": sheet.asked,
            }
        )
        return
    typer.echo(
        f"review {sheet.id}: {sheet.asked} of {sheet.boxes} boxes in {len(sheet.frames)} frames of "
        f"round {sheet.round}, weights by {sheet.policy}, in {directory}; see its README.txt"
    )


@group.command("import")
def import_review(
    directory: Annotated[Path, typer.Argument(help="The folder as it was exported and edited.")],
    answer: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="File or folder that the editor wrote, where it lies elsewhere."),
    ] = None,
    accept: Annotated[
        str,
        typer.Option(help="Frames whose unchanged boxes are accepted, comma-separated, or all."),
    ] = "",
    reviewer: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Who decided; default: you."),
    ] = None,
    from_round: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="First round in which it counts; default: the reviewed one."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would happen.")] = False,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Take back what was accepted, rejected, moved and added; it wins over any policy from then on.

    A box that came back unchanged counts as not looked at, unless review.csv or --accept says that
    it is accepted. The same import again changes nothing, one of corrected files takes the place of
    the former.

    Example: curate review import to-review --dry-run
    """
    from pipelines.review.importing import apply_review

    taken = apply_review(
        open_workspace(workspace),
        directory,
        answer=answer,
        accept=_names(accept),
        reviewer=reviewer,
        from_round=from_round,
        dry_run=dry_run,
    )
    if as_json:
        print_json(taken)
    else:
        typer.echo(_describe_import(taken))


@group.command("list")
def list_reviews(workspace: WorkspaceOption = None, as_json: JsonOption = False) -> None:
    """List the reviews with what was decided in them.

    Example: curate review list
    """
    from pipelines.review.exporting import reviews

    rows = reviews(open_workspace(workspace))
    if as_json:
        print_json([dict(zip(_COLUMNS, row, strict=True)) for row in rows])
    else:
        # To the minute, in UTC.
        print_table(
            _COLUMNS, [(*row[:7], *((at or "")[:16] for at in row[7:9]), *row[9:]) for row in rows]
        )


@group.command("clear")
def clear_reviews(
    reviews: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Argument(help="Reviews, as `curate review list` names them."),
    ] = None,
    frames: Annotated[str, typer.Option(help="Only in these frames, comma-separated.")] = "",
    everything: Annotated[bool, typer.Option("--all", help="Of all reviews.")] = False,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Forget human labels; the weights of the policies, which were kept, count again.

    Example: curate review clear --frames 000012,000017
    """
    from curate.errors import ConfigError
    from pipelines.review.importing import clear

    if not (reviews or frames or everything):
        raise ConfigError("clear: name reviews, --frames, or --all")
    gone = clear(open_workspace(workspace), reviews or (), _names(frames))
    if as_json:
        print_json({"cleared": gone})
    else:
        typer.echo(
            f"{gone} human labels forgotten; `curate run` brings files and students up to date"
        )


def register(app: typer.Typer) -> None:
    """Adds the commands."""
    app.add_typer(group)


def _names(text: str) -> tuple[str, ...]:
    return tuple(filter(None, (name.strip() for name in text.split(","))))


def _describe_import(taken: "ReviewImport") -> str:
    decisions = (
        f"{taken.accepted} accepted, {taken.rejected} rejected, {taken.moved} moved, "
        f"{taken.added} added, {taken.untouched} untouched"
    )
    where = f"{taken.frames} frames" + (
        f" ({taken.without_answer} did not come back)" if taken.without_answer else ""
    )
    line = f"review {taken.review}: {decisions} in {where}"
    if taken.replaced:
        line += f"; they take the place of {taken.replaced} earlier decisions"
    if taken.dry_run:
        return f"{line}; dry run, nothing is stored"
    if not taken.changed:
        decided = taken.accepted + taken.rejected + taken.moved + taken.added
        return f"{line}; {'stored already' if decided else 'nothing is decided yet'}"
    return f"{line}; they count from round {taken.from_round} on, `curate run` trains with them"
