"""The sequences of a data set, and the check that evidence sources have those that they need."""

from curate.datasets.base import Dataset, sequences_of, time_of
from curate.errors import ConfigError, error_prefix
from pipelines import registry
from pipelines.assembly import open_sequence_source
from pipelines.workspace.config import Config


def check_sequences(config: Config, dataset: Dataset) -> None:
    """Check that the data set has what the sources of `run.priors` for whole sequences need.

    Raises:
        ConfigError: if no frame belongs to a known sequence.
        DataError: if a source cannot use a frame, for example because its time is unknown.
    """
    for name in config.run.priors:
        if not hasattr(registry.PRIORS.load(name), "score_sequence"):
            continue
        sequences = sequences_of(dataset, dataset.frame_ids())
        if not sequences:
            raise ConfigError(
                f"run.priors: '{name}' needs sequences, but the data set {config.dataset.root} "
                f"(kind {config.dataset.kind}) has none: use a kind with sequences (see "
                f"docs/datasets.md), or leave '{name}' out of run.priors"
            )
        source = open_sequence_source(config, name)
        with error_prefix("run.priors"):
            for frame in sequences:
                source.check_frame(frame, time_of(dataset, frame))
