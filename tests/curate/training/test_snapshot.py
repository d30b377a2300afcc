"""Which trainings may resume from the same snapshot."""

from pathlib import Path

from curate.detectors.openpcdet import OpenPCDetDetector
from curate.training.settings import TrainingSettings
from curate.training.snapshot import fingerprint


def test_the_options_of_the_start_checkpoint_count_with_the_content_of_their_files(
    tmp_path: Path,
) -> None:
    """A model file that was edited while a training was killed starts it anew."""
    labels, start, model = (tmp_path / name for name in ("labels", "start.pth", "model.yaml"))
    for path in (labels, start, model):
        path.write_text(path.name)

    def mark(**options: object) -> str:
        return fingerprint(OpenPCDetDetector, labels, TrainingSettings(), start, options)

    first = mark(config=str(model))
    assert mark(config=str(model)) == first
    model.write_text("edited")
    others = {first, mark(), mark(config=str(model)), mark(config=str(model), x=1), mark(x=2)}
    assert len(others) == 5
