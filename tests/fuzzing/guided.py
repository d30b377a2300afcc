"""Coverage-guided fuzzing: python -m fuzzing.guided READER SECONDS, or `make fuzz`."""

import sys
import tempfile
from pathlib import Path


def main(name: str, seconds: int) -> int:
    """Damage the reader's valid file until an exception other than CurateError is raised."""
    try:
        import atheris
    except ImportError:
        sys.stderr.write("skipped: atheris is not installed; pip install atheris\n")
        return 0
    with atheris.instrument_imports(include=["curate", "pipelines", "db"]):
        from fuzzing.targets import TARGETS
    if name not in TARGETS:
        sys.stderr.write(f"no reader {name!r}: use one of {', '.join(TARGETS)}\n")
        return 2
    folder = Path(tempfile.mkdtemp())
    path = folder / TARGETS[name].name
    TARGETS[name].write(path)
    valid = path.read_bytes()

    def once(content: bytes) -> None:
        provider = atheris.FuzzedDataProvider(content)
        path.write_bytes(TARGETS[name].damage(valid, provider.ConsumeIntInRange))
        TARGETS[name].attempt(path)

    atheris.Setup([sys.argv[0], f"-max_total_time={seconds}", "-rss_limit_mb=2048"], once)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2])))
