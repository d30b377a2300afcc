"""Every number behind one weight, and the weight recomputed from them."""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import func, select, text

from curate.errors import WorkspaceError
from curate.weighting.self_paced import easiness
from db import bulk
from db.views import WEIGHTED_LABELS
from pipelines.config import Config
from pipelines.workspace import Workspace


@dataclass(frozen=True)
class View:
    """What one augmented copy said of a label."""

    view: int
    flip_y: bool
    rotation_rad: float
    scale: float
    score: float | None
    iou: float | None
    score_loss: float | None
    box_loss: float | None


@dataclass(frozen=True)
class Explanation:
    """A row of `weighted_labels`, the views behind its loss, and the weight recomputed."""

    label: dict[str, Any]
    views: tuple[View, ...]
    recomputed: float | None
    lines: tuple[str, ...]

    def as_text(self) -> str:
        """For a person."""
        return "\n".join(self.lines)


def explain_label(
    workspace: Workspace, frame: str, k: int, round_number: int | None, policy: str
) -> Explanation:
    """Why label k of a frame has its weight.

    Raises:
        WorkspaceError: the policy has not weighted such a label in that round.
    """
    label = _label(workspace, frame, k, round_number, policy)
    views = _views(workspace, label["round"], frame, k)
    recomputed = _weight(label)
    lines = _lines(workspace.config, label, views, recomputed)
    return Explanation(label, views, recomputed, tuple(lines))


def _label(
    workspace: Workspace, frame: str, k: int, round_number: int | None, policy: str
) -> dict[str, Any]:
    weight = bulk.table("weight")
    with workspace.database.reading() as connection:
        if round_number is None:
            newest = select(func.max(weight.c.round)).where(weight.c.policy == policy)
            round_number = connection.execute(newest).scalar_one()
        labels = WEIGHTED_LABELS.c
        key = {"round": round_number, "frame": frame, "k": k, "policy": policy}
        query = select(WEIGHTED_LABELS).where(*(labels[name] == key[name] for name in key))
        row = connection.execute(query).fetchone()
    if row is None:
        raise WorkspaceError(
            f"round {round_number or 1} has no label {k} of frame {frame} weighted by {policy}, or "
            "the policy dropped it; the view weighted_labels lists what there is, see "
            "`curate query --help`"
        )
    return dict(row._mapping)  # noqa: SLF001 - its public name


def _views(workspace: Workspace, round_number: int, frame: str, k: int) -> tuple[View, ...]:
    query = text(
        """
        SELECT v.view, v.flip_y, v.rotation_rad, v.scale, r.score, r.iou, r.score_loss, r.box_loss
        FROM reprediction_view AS v JOIN frame AS f ON f.id = v.frame_id
        LEFT JOIN reprediction AS r ON r.round = v.round AND r.frame_id = v.frame_id
            AND r.view = v.view AND r.matched_k = :k
        WHERE v.round = :round AND f.frame = :frame ORDER BY v.view
        """
    )
    with workspace.database.reading() as connection:
        rows = connection.execute(query, {"round": round_number, "frame": frame, "k": k})
        return tuple(View(row[0], bool(row[1]), *row[2:]) for row in rows)


def _weight(label: dict[str, Any]) -> float | None:
    """The weight by Eqs. 7 and 11; None for policies that do not use them.

    A label that matched has a lambda unless the policy was told to do without: it weighs rho_det.
    """
    if label["policy"] not in {"spsl", "pspsl"}:
        return None
    if label["loss"] is None:
        return 0.0
    if label["lambda_u"] is None:
        return float(label["rho_det"])
    import numpy as np

    v = float(easiness(np.array([label["loss"]]), np.array([label["lambda_u"]]))[0])
    return v * (label["rho_det"] if label["policy"] == "pspsl" else 1.0)


def _lines(
    config: Config, label: dict[str, Any], views: tuple[View, ...], recomputed: float | None
) -> list[str]:
    number = {
        name: "none" if value is None else f"{value:.4f}" if isinstance(value, float) else value
        for name, value in label.items()
    }
    section = config.repredict
    lines = [
        "round {round}, frame {frame}, label {k}: {category}, score {score}".format(**number),
        "  box            x {x}  y {y}  z {z}  l {length}  w {width}  h {height}  yaw {yaw}".format(
            **number
        ),
    ]
    lines += [f"  {_view_line(view)}" for view in views]
    lines.append(
        f"  consistency    L = {section.score_weight:g} (-ln s') + {section.box_weight:g} box loss"
        f", mean over matched views = {number['loss']}"
    )
    if label["points"] is not None:
        lines.append(
            "  points, Eq. 8  rho_diff = min({points}, {points_threshold}) / {points_threshold} "
            "= {rho_diff}".format(**number)
        )
    if label["box_pixels"] is not None:
        formula = {
            "geometric": "sqrt(s S/A)", "product": "s S/A", "arithmetic": "(s + S/A) / 2",
        }[config.semantic.mean]  # fmt: skip
        lines.append(
            f"  semantic, Eq. 9  rho_anno = {formula} with s = {number['score']}, "
            f"S = {number['mask_pixels']}, A = {number['box_pixels']} pixels = {number['rho_anno']}"
        )
    lines.append("  priors         rho_det = {rho_det}".format(**number))
    lines.append("  age, Eq. 4     lambda = {lambda_u}".format(**number))
    formulas = {"spsl": "1 - L / lambda, Eq. 7", "pspsl": "rho_det (1 - L / lambda), Eq. 11"}
    if label["lambda_u"] is None and label["loss"] is not None:
        formulas["pspsl"] = "rho_det, without the self-paced term"
    formula = formulas.get(label["policy"], "see curate solve --help")
    lines.append(f"  policy         {label['policy']}: v = {formula}")
    lines.append(f"  weight         {number['weight']}")
    if recomputed is not None:
        lines.append(f"  recomputed     {recomputed:.4f}")
    return lines


def _view_line(view: View) -> str:
    how = (
        f"view {view.view}: {'flipped, ' if view.flip_y else ''}"
        f"rotated {view.rotation_rad:+.3f} rad, scaled {view.scale:.3f}"
    )
    if view.score is None:
        return f"{how}: no match"
    return (
        f"{how}: matched with BEV IoU {view.iou:.3f}, s' {view.score:.4f}, -ln s' "
        f"{view.score_loss:.4f}, box loss {view.box_loss:.4f}"
    )
