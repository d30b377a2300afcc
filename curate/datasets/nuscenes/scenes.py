"""Which scenes of nuScenes are for validation, so that no scene is on both sides.

Source: the official splits of nuScenes (Caesar et al., "nuScenes", CVPR 2020; nuscenes.org).
"""

from collections.abc import Iterable, Mapping

# Numbers of v1.0-trainval's 150 validation scenes, first and last of each run.
_VAL = (
    (3, 3), (12, 18), (35, 36), (38, 39), (92, 110), (221, 221), (268, 278), (329, 332),
    (344, 346), (519, 524), (552, 565), (625, 627), (629, 630), (632, 638), (770, 771),
    (775, 775), (777, 778), (780, 784), (794, 800), (802, 802), (904, 917), (919, 931),
    (962, 963), (966, 969), (971, 972), (1059, 1073),
)  # fmt: skip
_MINI_VAL = ((103, 103), (916, 916))
_RUNS: Mapping[str, tuple[tuple[int, int], ...]] = {"v1.0-trainval": _VAL, "v1.0-mini": _MINI_VAL}


def validation_scenes(version: str, scenes: Iterable[str]) -> frozenset[str]:
    """The official validation scenes among those of a version; none where there is no such split.

    Args:
        version: v1.0-trainval, v1.0-mini or another.
        scenes: names such as scene-0103.
    """
    names = {
        f"scene-{number:04d}"
        for first, last in _RUNS.get(version, ())
        for number in range(first, last + 1)
    }
    return frozenset(names & set(scenes))
