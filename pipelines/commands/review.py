"""curate review: export labels to an editor and import decisions from it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from pipelines.commands.options import (
    JsonOption,
    LastRoundOption,
    PolicyOption,
    WorkspaceOption,
    complete,
    one_of,
    open_workspace,
)
from pipelines.registry import EDITORS
from pipelines.reports.terminal import print_json, print_line, print_table

if TYPE_CHECKING:
    from pipelines.review.importing import ReviewImport

group = typer.Typer(
    name="review",
    help="Have people correct labels; their decisions override every policy.",
    no_args_is_help=True,
    rich_markup_mode=None,
)
_COLUMNS = (
    "review", "round", "policy", "format", "frames", "boxes", "asked", "exported", "imported",
    "accepted", "rejected", "moved", "added",
)  # fmt: skip


@group.command("export")
def export_review(
    directory: Annotated[Path, typer.Argument(help="Folder to create; it must not exist yet.")],
    round_number: LastRoundOption = None,
    policy: PolicyOption = None,
    count: Annotated[int, typer.Option(min=1, help="Number of labels to review.")] = 100,
    order: Annotated[
        str,
        typer.Option("--by", help="What to review first: uncertain, lowest, changed or proposals."),
    ] = "uncertain",
    frames: Annotated[
        str, typer.Option(help="Only these frames, comma-separated; exported even without labels.")
    ] = "",
    category: Annotated[str, typer.Option(help="Only these categories, comma-separated.")] = "",
    form: Annotated[
        str,
        typer.Option(
            "--format",
            help=f"Editor: {one_of((*EDITORS.classes, 'module:Class'))}.",
            autocompletion=complete(EDITORS.classes),
        ),
    ] = "kitti",
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Export the least certain labels for an editor, with images of their frames.

    --by chooses which labels come first. uncertain: weight nearest to 0.5. lowest: lowest weight,
    ties by highest score. changed: largest change since the previous round. proposals: the missed
    objects of `curate propose`, those with the most points. The other labels of these frames with a
    weight of at least 0.1 are exported as context and can be corrected, too. docs/review.md has an
    example.

    Example: curate review export to-review --count 50 --category Pedestrian,Cyclist
    """
    from pipelines.engine.progress import Bar
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
    print_line(
        f"review {sheet.id}: {sheet.asked} of {sheet.boxes} boxes in {len(sheet.frames)} frames of "
        f"round {sheet.round}, weights by {sheet.policy}, in {directory}; see its README.txt"
    )


@group.command("import")
def import_review(
    directory: Annotated[Path, typer.Argument(help="The exported folder, after editing.")],
    answer: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="File or folder that the editor wrote, if it is elsewhere."),
    ] = None,
    accept: Annotated[
        str,
        typer.Option(
            help="Frames with unchanged boxes that count as accepted, comma-separated, or all."
        ),
    ] = "",
    reviewer: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Name of the reviewer; default: your user name."),
    ] = None,
    from_round: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            min=1, help="First round in which the decisions count; default: the reviewed one."
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print what would be imported; store nothing.")
    ] = False,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Import accepted, rejected, moved and added labels; they override every policy.

    An unchanged box counts as not reviewed, unless review.csv or --accept accepts it. Importing the
    same files again changes nothing; importing corrected files replaces the earlier decisions.

    Example: curate review import to-review --dry-run
    """
    from pipelines.review.importing import apply_review

    found = apply_review(
        open_workspace(workspace),
        directory,
        edited=answer,
        accept=_names(accept),
        reviewer=reviewer,
        from_round=from_round,
        dry_run=dry_run,
    )
    if as_json:
        print_json(found)
    else:
        print_line(_describe_import(found))


@group.command("list")
def list_reviews(workspace: WorkspaceOption = None, as_json: JsonOption = False) -> None:
    """List the reviews and the decisions made in them.

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
        typer.Argument(help="Ids of reviews, see `curate review list`."),
    ] = None,
    frames: Annotated[str, typer.Option(help="Only in these frames, comma-separated.")] = "",
    everything: Annotated[
        bool, typer.Option("--all", help="Delete the decisions of all reviews.")
    ] = False,
    workspace: WorkspaceOption = None,
    as_json: JsonOption = False,
) -> None:
    """Delete human labels; the stored weights of the policies apply again.

    Example: curate review clear --frames 000012,000017
    """
    from curate.errors import ConfigError
    from pipelines.review.importing import clear

    if not (reviews or frames or everything):
        raise ConfigError("clear: give review ids, --frames or --all")
    deleted = clear(open_workspace(workspace), reviews or (), _names(frames))
    if as_json:
        print_json({"cleared": deleted})
    else:
        typer.echo(f"{deleted} human labels deleted; `curate run` updates files and students")


def _names(text: str) -> tuple[str, ...]:
    return tuple(filter(None, (name.strip() for name in text.split(","))))


def _describe_import(found: "ReviewImport") -> str:
    decisions = (
        f"{found.accepted} accepted, {found.rejected} rejected, {found.moved} moved, "
        f"{found.added} added, {found.untouched} untouched"
    )
    frames = f"{found.frames} frames" + (
        f" ({found.missing} more without edits)" if found.missing else ""
    )
    line = f"review {found.review}: {decisions} in {frames}"
    if found.replaced:
        line += f"; they replace {found.replaced} earlier decisions"
    if found.dry_run:
        return f"{line}; dry run, nothing is stored"
    if not found.changed:
        decided = found.accepted + found.rejected + found.moved + found.added
        return f"{line}; {'already stored' if decided else 'no decisions yet'}"
    return f"{line}; they count from round {found.from_round} on; `curate run` trains with them"
