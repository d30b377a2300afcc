"""score --prior points: LiDAR points inside the box (Eq. 8), against those inside boxes of X_l."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from curate.priors.base import Prior
from curate.priors.points import PointPrior, learn_thresholds
from pipelines.assembly import point_settings
from pipelines.stage import RoundContext, Settings
from pipelines.stages.score import Score
from pipelines.workspace import Workspace


@dataclass
class ScorePoints(Score):
    """Counts the points in the boxes of a frame."""

    thresholds: Mapping[str, float] = field(default_factory=dict)

    def open_prior(self) -> Prior:
        """The point prior with the thresholds learned from X_l."""
        return PointPrior(self.thresholds)


def settings(workspace: Workspace, _context: RoundContext) -> Settings:
    """What rho_diff depends on beside predictions and ground truth."""
    return workspace.config.points.model_dump(mode="json")


def function(workspace: Workspace, _context: RoundContext) -> ScorePoints:
    """What score does with a frame; X_l is read here, once."""
    truth = workspace.ground_truth("labeled")
    learned = learn_thresholds(
        ((workspace.dataset.read(frame), annotations) for frame, annotations in truth.items()),
        workspace.config.dataset.categories,
        point_settings(workspace.config),
    )
    return ScorePoints(workspace.config, "point_prior", learned.values)
