"""The DAG as text and as Mermaid source; its edges follow from what stages read and write."""

from pipelines.round import ROUND


def as_text() -> str:
    """A line per stage: inputs -> stage -> outputs."""
    reads = [", ".join(stage.reads) for stage in ROUND]
    width = max(map(len, reads))
    return "\n".join(
        f"{read:>{width}} -> {stage.name:<11} -> {', '.join(stage.writes)}"
        for read, stage in zip(reads, ROUND, strict=True)
    )


def as_mermaid() -> str:
    """A flowchart of tables (rounded) and stages (boxes)."""
    lines = ["flowchart LR"]
    for stage in ROUND:
        node = stage.name.replace("-", "_")
        lines.append(f"    {node}[{stage.name}]")
        lines += [f"    {_name(name)}({name}) --> {node}" for name in stage.reads]
        lines += [f"    {node} --> {_name(name)}({name})" for name in stage.writes]
    return "\n".join(lines)


def _name(table: str) -> str:
    return "t_" + table.replace(".", "_")
