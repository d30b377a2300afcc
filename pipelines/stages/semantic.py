"""score --prior semantic: pixels of the label's class inside the projected box (Eq. 9)."""

from curate.priors.base import Prior
from curate.priors.semantic import SemanticPrior
from pipelines.assembly import open_segmenter, segmenter_path, semantic_settings
from pipelines.stage import RoundContext, Settings
from pipelines.stages.score import Score
from pipelines.workspace import Workspace, sha256


class ScoreSemantic(Score):
    """Looks at the semantic map of a frame."""

    def open_prior(self) -> Prior:
        """The semantic prior with its segmenter."""
        return SemanticPrior(open_segmenter(self.config), semantic_settings(self.config))


def settings(workspace: Workspace, _context: RoundContext) -> Settings:
    """What rho_anno depends on beside predictions: formula and segmenter."""
    config = workspace.config
    path = segmenter_path(config)
    model = sha256(path) if path is not None and path.is_file() else str(path)
    return {
        **config.semantic.model_dump(mode="json"),
        "segmenter": config.segmenter.model_dump(mode="json", exclude={"path"}),
        "model": model,
    }


def function(workspace: Workspace, _context: RoundContext) -> ScoreSemantic:
    """What score does with a frame."""
    return ScoreSemantic(workspace.config, "semantic_prior")
