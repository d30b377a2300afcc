"""Which round it is, and which detector answers in it."""

import json
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, func, select

import curate
from curate.errors import WorkspaceError
from db import bulk
from pipelines.assembly import trainable_detector
from pipelines.engine.stage import RoundContext, Teacher
from pipelines.workspace.workspace import Workspace, sha256


def is_trainable(workspace: Workspace) -> bool:
    """Return whether curate trains the configured detector; otherwise it is external.

    Raises:
        ConfigError: if its class cannot be used, or has no preset of the configured name.
    """
    return trainable_detector(workspace.config) is not None


def is_pretrained(workspace: Workspace) -> bool:
    """Return whether curate trains the first teacher, as the user brings no checkpoint of it."""
    return is_trainable(workspace) and workspace.config.detector.path is None


def is_student_trained(workspace: Workspace) -> bool:
    """Return whether rounds end with a student: curate's own, or that of the user's command."""
    return is_trainable(workspace) or workspace.config.train.command is not None


def open_round(
    workspace: Workspace, number: int | None = None, rounds: int | None = None
) -> RoundContext:
    """Return a round, made where it does not exist yet.

    Args:
        workspace: see `Workspace`.
        number: e; None for the first that has no student yet.
        rounds: E for a round that has no student yet; None for the configured number.

    Raises:
        WorkspaceError: if the detector that would answer in the round does not exist yet or is not
            the one that was stored, or the workspace has no frames.
        DatabaseError: if another process works on the round with other settings.
    """
    if not _has_frames(workspace):
        raise WorkspaceError(
            f"{workspace.root}: holds no frames, its init was interrupted; "
            "run `curate init` again with the same arguments"
        )
    number, rounds = choose_round(workspace, number, rounds)
    teacher_id, teacher = find_teacher(workspace, number, to_work=True)
    row = {
        "number": number,
        "rounds": rounds,
        "teacher_id": teacher_id,
        "config": _recorded_config(workspace),
        "code_version": curate.__version__,
        "seed": workspace.config.run.seed,
    }
    _record_round(workspace, row)
    return RoundContext(number, rounds, workspace.config.run.seed, teacher)


def choose_round(workspace: Workspace, number: int | None, rounds: int | None) -> tuple[int, int]:
    """Return the number e of the round to work on and the count E of rounds, see `open_round`."""
    students = _students(workspace)
    wanted = rounds or workspace.config.run.rounds
    if number is None:
        number = next(e for e in range(1, wanted + 1) if e not in students or e == wanted)
    stored = _stored_rounds(workspace, number)
    return number, stored if stored and number in students else max(wanted, number)


def preview_round(
    workspace: Workspace, number: int | None = None, rounds: int | None = None
) -> RoundContext:
    """Return a round as `open_round` would make it, without writing anything.

    Raises:
        WorkspaceError: if the detector of the round does not exist yet.
    """
    number, rounds = choose_round(workspace, number, rounds)
    _, teacher = find_teacher(workspace, number)
    return RoundContext(number, rounds, workspace.config.run.seed, teacher)


def recorded_config(workspace: Workspace, number: int) -> dict[str, Any] | None:
    """Return the configuration that a round was last worked on with; None for a new round."""
    table = bulk.table("round")
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, select(table.c.config).where(table.c.number == number))
    return json.loads(rows[0][0]) if rows else None


def _recorded_config(workspace: Workspace) -> str:
    """Return the configuration as JSON, without what says where and by how many the work is done.

    Several processes that differ only in this share a round; and the URL may hold a password.
    """
    exclude = {"run": {"executor", "workers", "database"}, "train": {"threads"}}
    return json.dumps(workspace.config.model_dump(mode="json", exclude=exclude))


def _record_round(workspace: Workspace, row: dict[str, Any]) -> None:
    """Store a round; one that another process works on keeps its settings."""
    table, number = bulk.table("round"), row["number"]
    query = select(*(table.c[name] for name in row)).where(table.c.number == number)
    stored = workspace.database.rows(query)
    if stored == [tuple(row.values())]:
        return
    with (
        workspace.database.claiming_round(number, None, "a change of its settings"),
        workspace.database.writing() as connection,
    ):
        changed = connection.execute(table.update().where(table.c.number == number).values(**row))
        if changed.rowcount == 0:
            connection.execute(table.insert().values(**row))


def peek_round(workspace: Workspace, number: int) -> RoundContext | None:
    """A round as it is stored, without making or changing it; None where its teacher is gone."""
    try:
        _, teacher = find_teacher(workspace, number)
    except WorkspaceError:
        return None
    rounds = _stored_rounds(workspace, number) or workspace.config.run.rounds
    return RoundContext(number, max(rounds, number), workspace.config.run.seed, teacher)


def find_teacher(
    workspace: Workspace, number: int, *, to_work: bool = False
) -> tuple[int | None, Teacher]:
    """Return the key and the file of the detector that answers in a round.

    A detector or checkpoint that the user brings answers in the first round, and in later ones as
    well where it is not trained; where it is, the student of the round before does.

    Args:
        workspace: see `Workspace`.
        number: e.
        to_work: whether it is about to answer, so that its file must be the one that was stored.
            Otherwise nothing is written, and an external detector that was never used has no key.

    Raises:
        WorkspaceError: if it does not exist yet, or is another.
        ConfigError: if the user's file does not exist.
        ModelError: if it is about to answer and is not a checkpoint of the configured detector.
    """
    trainable = trainable_detector(workspace.config)
    brought = not is_pretrained(workspace)
    if brought and number == 1:
        key, teacher = _external_detector(workspace, record=to_work)
        if to_work and trainable:
            trainable.detector.check_checkpoint(teacher.path)
        return key, teacher
    table = bulk.table("checkpoint")
    policy = workspace.config.run.method if number > 1 else ""
    query = select(table.c.id, table.c.path, table.c.sha256, table.c.detector).where(
        table.c.round == number - 1, table.c.policy == policy
    )
    found = workspace.database.rows(query)
    before = "curate pretrain" if number == 1 else f"curate train-round --round {number - 1}"
    if not found and brought and not is_student_trained(workspace):
        return _external_detector(workspace, record=to_work)
    if not found:
        raise WorkspaceError(f"round {number} has no teacher yet; run `{before}`")
    key, path, digest, detector = found[0]
    place = workspace.root / path
    if not (place.is_file() or place.is_dir()):  # a pipe in its place would never end
        raise WorkspaceError(f"{place}: the checkpoint is gone; run `{before}`")
    if to_work and sha256(place) != digest:  # its answers would be taken for those of the other
        raise WorkspaceError(
            f"{place}: has changed since it was made; put the one that was made back, or take the "
            f"file away and run `{before}`"
        )
    if to_work and trainable:
        now = workspace.config.detector.name
        if detector != now:
            raise WorkspaceError(
                f"{place}: is a checkpoint of detector '{detector}', and detector.name is '{now}'; "
                f"run `{before}`, or set detector.name back"
            )
        trainable.detector.check_checkpoint(place)
    return key, Teacher(place, digest)


def newest_checkpoint(workspace: Workspace) -> Path:
    """Return the student of the last round under the configured policy, else the first teacher.

    Raises:
        WorkspaceError: if there is no detector yet.
    """
    students = _students(workspace)
    number = max(students, default=0) + 1
    return find_teacher(workspace, number, to_work=True)[1].path


def register_checkpoint(
    connection: Connection, workspace: Workspace, round_number: int, policy: str, path: Path
) -> None:
    """Store a checkpoint in place of an earlier one of the same round and policy."""
    table = bulk.table("checkpoint")
    row = {
        "detector": workspace.config.detector.name,
        "path": workspace.relative(path),
        "sha256": sha256(path),
        "created_at": func.current_timestamp(),
    }
    same = (table.c.round == round_number, table.c.policy == policy)
    if connection.execute(table.update().where(*same).values(**row)).rowcount == 0:
        connection.execute(table.insert().values(round=round_number, policy=policy, **row))


def _external_detector(workspace: Workspace, *, record: bool) -> tuple[int | None, Teacher]:
    """Return the detector that the user brought, which answers in every round."""
    path = workspace.config.detector.path
    if path is None:
        raise WorkspaceError(
            f"detector '{workspace.config.detector.name}' needs a path: set detector.path in "
            f"{workspace.root / 'curate.toml'}"
        )
    path = workspace.root / path
    digest = sha256(path)
    table = bulk.table("checkpoint")
    query = select(table.c.id, table.c.sha256).where(table.c.round == 0, table.c.policy == "")
    found = workspace.database.rows(query)
    if not found or found[0][1] != digest:
        if not record:
            return None, Teacher(path, digest)
        with workspace.database.writing() as connection:
            register_checkpoint(connection, workspace, 0, "", path)
            found = bulk.select(connection, query)
    return found[0][0], Teacher(path, digest)


def _has_frames(workspace: Workspace) -> bool:
    return bool(workspace.database.rows(select(bulk.table("frame").c.id).limit(1)))


def _students(workspace: Workspace) -> set[int]:
    """Return the rounds that have trained a student with the configured policy."""
    table = bulk.table("checkpoint")
    query = select(table.c.round).where(table.c.policy == workspace.config.run.method)
    return {row[0] for row in workspace.database.rows(query)}


def _stored_rounds(workspace: Workspace, number: int) -> int | None:
    table = bulk.table("round")
    rows = workspace.database.rows(select(table.c.rounds).where(table.c.number == number))
    return rows[0][0] if rows else None
