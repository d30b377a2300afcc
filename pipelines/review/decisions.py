"""Descriptions of what people decided about labels."""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import select

from db import bulk
from pipelines.labels.human_labels import FIRST_K
from pipelines.workspace.workspace import Workspace


@dataclass(frozen=True)
class LabelDecision:
    """A decision about a label of `weighted_labels`.

    Attributes:
        lines: its description.
        policy_weight: weight that the policy alone gives to the prediction that the label replaces;
            None if it replaces none.
    """

    lines: tuple[str, ...]
    policy_weight: float | None


def describe_decision(workspace: Workspace, label: dict[str, Any]) -> LabelDecision:
    """Describe who decided what, and the weight that the policy alone would give.

    Args:
        workspace: see `Workspace`.
        label: a row of `weighted_labels` with the provenance human.
    """
    human, match, frame, weight = (
        bulk.table(name) for name in ("human_label", "human_match", "frame", "weight")
    )
    key = select(frame.c.id).where(frame.c.frame == label["frame"]).scalar_subquery()
    here = {"round": label["round"], "frame_id": key, "k": label["k"]}
    n = select(match.c.n).where(*(match.c[name] == at for name, at in here.items()))
    v = select(weight.c.v).where(
        weight.c.policy == label["policy"], *(weight.c[name] == at for name, at in here.items())
    )
    with workspace.database.reading() as connection:
        number = connection.execute(n).scalar()
        policy_weight = connection.execute(v).scalar()
        this_label = (
            human.c.frame_id == key,
            human.c.n == (label["k"] - FIRST_K if number is None else number),
        )
        names = ("decision", "reviewer", "decided_at", "review")
        row = connection.execute(
            select(*(human.c[name] for name in names)).where(*this_label)
        ).one()
    who = f"by {row.reviewer} at {row.decided_at}, in review {row.review}"
    lines = [f"  human          {row.decision} {who}: weight {label['weight']:g}"]
    if policy_weight is not None:
        lines.append(
            f"  policy         {label['policy']} alone gives the prediction {policy_weight:.4f}"
        )
    return LabelDecision(tuple(lines), policy_weight)
