"""How busy the GPU is while a block runs, as NVIDIA's own tool reports it."""

import shutil
import subprocess
from statistics import mean
from typing import Self

QUERY = ("--query-gpu=utilization.gpu,memory.used", "--format=csv,noheader,nounits", "-lms", "100")


class Utilisation:
    """Samples the utilisation and memory of the first GPU every 100 ms, inside a `with` block."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._samples: list[tuple[float, float]] = []

    def __enter__(self) -> Self:
        program = shutil.which("nvidia-smi")
        if program:
            self._process = subprocess.Popen(
                [program, "--id=0", *QUERY], stdout=subprocess.PIPE, text=True
            )
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is None:
            return
        self._process.terminate()
        output, _ = self._process.communicate()
        rows = [line.split(",") for line in output.splitlines() if line.count(",") == 1]
        self._samples = [(float(busy), float(used)) for busy, used in rows if "N/A" not in busy]

    def __str__(self) -> str:
        """Return mean utilisation and highest memory, or that they are unknown."""
        if not self._samples:
            return "utilisation unknown (no nvidia-smi)"
        busy, used = zip(*self._samples, strict=True)
        return f"GPU {mean(busy):.0f} % busy, {max(used):.0f} MiB used"
