"""score: a prior trusts or mistrusts every label of a frame; each prior is a stage of its own."""

from dataclasses import dataclass

from curate.errors import WorkspaceError
from curate.priors.base import Prior, columns
from pipelines.config import Config
from pipelines.executors.base import FrameJob, FrameRows
from pipelines.workspace import open_dataset


@dataclass
class Score:
    """Asks one prior about the labels of a frame."""

    config: Config
    table: str

    def open(self) -> None:
        """Loads the data set and what the prior needs."""
        self.dataset = open_dataset(self.config)
        self.prior = self.open_prior()

    def open_prior(self) -> Prior:
        """The prior to ask."""
        raise NotImplementedError

    def __call__(self, job: FrameJob) -> FrameRows:
        """The rows of the prior's table."""
        if job.predictions is None:
            raise WorkspaceError(f"frame {job.frame} came without its predictions")
        frame = self.dataset.read(job.frame, image=self.prior.needs_image)
        found = columns(self.prior.score(frame, job.predictions))
        numbers = zip(*(column.tolist() for column in found.values()), strict=True)
        return {self.table: [(k, *row) for k, row in enumerate(numbers)]}
