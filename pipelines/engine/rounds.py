"""Rounds as stored in the database, and the detector that predicts in each."""

import json
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, func, select

import curate
from curate.errors import WorkspaceError
from db import bulk
from pipelines.assembly import runs_elsewhere, trainable_detector
from pipelines.engine.stage import RoundContext, Teacher
from pipelines.workspace.workspace import Workspace, sha256


def is_trainable(workspace: Workspace) -> bool:
    """Return whether curate trains the configured detector; otherwise it is external.

    Raises:
        ConfigError: if its class cannot be used, or has no preset of the configured name.
    """
    return trainable_detector(workspace.config) is not None


def is_pretrained(workspace: Workspace) -> bool:
    """Return whether curate trains the first teacher: the user supplies no checkpoint for it."""
    return is_trainable(workspace) and workspace.config.detector.path is None


def is_student_trained(workspace: Workspace) -> bool:
    """Return whether rounds train a student, by curate or by the user's command."""
    return is_trainable(workspace) or workspace.config.train.command is not None


def open_round(
    workspace: Workspace, number: int | None = None, rounds: int | None = None
) -> RoundContext:
    """Return a round, and record it in the database with the current configuration.

    Args:
        workspace: the workspace.
        number: number e of the round; None for the first round without a student.
        rounds: number E of rounds, for a round without a student; None for the configured number.

    Raises:
        WorkspaceError: if the workspace has no frames, or the round's teacher does not exist yet or
            differs from the stored one.
        DatabaseError: if another process works on the round with other settings.
    """
    if not _has_frames(workspace):
        raise WorkspaceError(
            f"{workspace.root}: the workspace has no frames, because its init was interrupted; "
            "rerun `curate init` with the same arguments"
        )
    number, rounds = choose_round(workspace, number, rounds)
    teacher_id, teacher = find_teacher(workspace, number, for_use=True)
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


def outside_rounds(workspace: Workspace) -> RoundContext:
    """Return the context of work that depends on no round and no teacher."""
    run = workspace.config.run
    return RoundContext(0, run.rounds, run.seed, Teacher(Path(), ""))


def choose_round(workspace: Workspace, number: int | None, rounds: int | None) -> tuple[int, int]:
    """Return the number e of the round to work on and the number E of rounds, see `open_round`."""
    students = _students(workspace)
    requested = rounds or workspace.config.run.rounds
    if number is None:
        number = next(e for e in range(1, requested + 1) if e not in students or e == requested)
    stored = _stored_rounds(workspace, number)
    return number, stored if stored and number in students else max(requested, number)


def preview_round(
    workspace: Workspace, number: int | None = None, rounds: int | None = None
) -> RoundContext:
    """Return the round that `open_round` would return, without writing anything.

    Raises:
        WorkspaceError: if the round's teacher does not exist yet.
    """
    number, rounds = choose_round(workspace, number, rounds)
    _, teacher = find_teacher(workspace, number)
    return RoundContext(number, rounds, workspace.config.run.seed, teacher)


def recorded_config(workspace: Workspace, number: int) -> dict[str, Any] | None:
    """Return the configuration of a round's last run; None for a new round."""
    table = bulk.table("round")
    with workspace.database.reading() as connection:
        rows = bulk.select(connection, select(table.c.config).where(table.c.number == number))
    return json.loads(rows[0][0]) if rows else None


def _recorded_config(workspace: Workspace) -> str:
    """Return the configuration as JSON, without the settings that change no result.

    Processes that differ only in these can share a round, and the database's URL may contain a
    password.
    """
    exclude = {
        "run": {"executor", "workers", "database"},
        "detector": {"batch_size", "workers", "timeout_s", "score_meaning"},
        "segmenter": {"cache", "cache_limit"},
        "train": {"loaders", "processes", "threads"},
    }
    return json.dumps(workspace.config.model_dump(mode="json", exclude=exclude))


def _record_round(workspace: Workspace, row: dict[str, Any]) -> None:
    """Store a round, unless it is stored with the same values already."""
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
        if not workspace.config.repredict.fuse:
            _delete_fused_boxes(connection, number)


def _delete_fused_boxes(connection: Connection, number: int) -> None:
    """Delete the fused boxes of a round without fusion, so that its labels have no other boxes."""
    fused, task = bulk.table("fused_box"), bulk.table("task")
    connection.execute(fused.delete().where(fused.c.round == number))
    connection.execute(task.delete().where(task.c.round == number, task.c.stage == "fuse"))


def stored_round(workspace: Workspace, number: int) -> RoundContext | None:
    """Return a round without creating or changing it; None if its teacher does not exist."""
    try:
        _, teacher = find_teacher(workspace, number)
    except WorkspaceError:
        return None
    rounds = _stored_rounds(workspace, number) or workspace.config.run.rounds
    return RoundContext(number, max(rounds, number), workspace.config.run.seed, teacher)


def find_teacher(
    workspace: Workspace, number: int, *, for_use: bool = False
) -> tuple[int | None, Teacher]:
    """Return the key and the file of the detector that predicts in a round.

    In the first round it is the user's detector or checkpoint, or the one from `curate pretrain`.
    In later rounds it is the student of the round before. Without students, the user's detector
    predicts in every round.

    Args:
        workspace: the workspace.
        number: number e of the round.
        for_use: whether the detector is about to predict. Then its file is compared with the stored
            hash, and an external detector is recorded. Otherwise nothing is written, and the key of
            an external detector that was never used is None.

    Raises:
        WorkspaceError: if the detector does not exist yet, or differs from the stored one.
        ConfigError: if the user's file does not exist.
        ModelError: if `for_use`, and the file is not a checkpoint of the configured detector.
    """
    trainable = trainable_detector(workspace.config)
    supplied = not is_pretrained(workspace)
    if supplied and number == 1:
        key, teacher = _external_detector(workspace, record=for_use)
        if for_use and trainable and teacher.path:
            trainable.detector.check_checkpoint(teacher.path)
        return key, teacher
    table = bulk.table("checkpoint")
    policy = workspace.config.run.method if number > 1 else ""
    query = select(table.c.id, table.c.path, table.c.sha256, table.c.detector).where(
        table.c.round == number - 1, table.c.policy == policy
    )
    found = workspace.database.rows(query)
    command = "curate pretrain" if number == 1 else f"curate train-round --round {number - 1}"
    if not found and supplied and not is_student_trained(workspace):
        return _external_detector(workspace, record=for_use)
    if not found:
        raise WorkspaceError(f"round {number} has no teacher yet; run `{command}`")
    key, path, digest, detector = found[0]
    file = workspace.root / path
    if not (file.is_file() or file.is_dir()):  # reading a named pipe would block forever
        raise WorkspaceError(f"{file}: the checkpoint is missing; run `{command}`")
    if for_use and sha256(file) != digest:  # its predictions would be stored as the old one's
        raise WorkspaceError(
            f"{file}: the checkpoint has changed since it was trained; restore the original, or "
            f"delete the file and run `{command}`"
        )
    if for_use and trainable:
        configured = workspace.config.detector.name
        if detector != configured:
            raise WorkspaceError(
                f"{file}: is a checkpoint of detector '{detector}', but detector.name is "
                f"'{configured}'; run `{command}`, or set detector.name back"
            )
        trainable.detector.check_checkpoint(file)
    return key, Teacher(file, digest)


def newest_checkpoint(workspace: Workspace) -> Path | None:
    """Return the file of the newest student under the configured policy, or the first teacher's.

    None for a command without a checkpoint.

    Raises:
        WorkspaceError: if no detector exists yet.
    """
    students = _students(workspace)
    number = max(students, default=0) + 1
    return find_teacher(workspace, number, for_use=True)[1].path


def register_checkpoint(
    connection: Connection, workspace: Workspace, round_number: int, policy: str, path: Path
) -> None:
    """Store a checkpoint; it replaces an earlier one of the same round and policy."""
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
    """Return the key and the file of the detector that the user supplied."""
    path = workspace.config.detector.path
    if path is None and runs_elsewhere(workspace.config):
        return None, Teacher(None, "")
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
    """Return the numbers of the rounds that have trained a student with the configured policy."""
    table = bulk.table("checkpoint")
    query = select(table.c.round).where(table.c.policy == workspace.config.run.method)
    return {row[0] for row in workspace.database.rows(query)}


def _stored_rounds(workspace: Workspace, number: int) -> int | None:
    table = bulk.table("round")
    rows = workspace.database.rows(select(table.c.rounds).where(table.c.number == number))
    return rows[0][0] if rows else None
