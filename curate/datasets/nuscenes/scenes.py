"""The official validation scenes of nuScenes; no scene is in both train and val.

Source: the official splits of nuScenes (Caesar et al., "nuScenes", CVPR 2020; nuscenes.org).
"""

from collections.abc import Iterable, Mapping

# The 150 validation scenes of v1.0-trainval as ranges: first and last scene number.
_VAL = (
    (3, 3), (12, 18), (35, 36), (38, 39), (92, 110), (221, 221), (268, 278), (329, 332),
    (344, 346), (519, 524), (552, 565), (625, 627), (629, 630), (632, 638), (770, 771),
    (775, 775), (777, 778), (780, 784), (794, 800), (802, 802), (904, 917), (919, 931),
    (962, 963), (966, 969), (971, 972), (1059, 1073),
)  # fmt: skip
_MINI_VAL = ((103, 103), (916, 916))
_RANGES: Mapping[str, tuple[tuple[int, int], ...]] = {"v1.0-trainval": _VAL, "v1.0-mini": _MINI_VAL}


def validation_scenes(version: str, scenes: Iterable[str]) -> frozenset[str]:
    """Return the official validation scenes among `scenes`; none if the version has no split.

    Args:
        version: name of the version; v1.0-trainval and v1.0-mini have a split.
        scenes: scene names, such as scene-0103.
    """
    names = {
        f"scene-{number:04d}"
        for first, last in _RANGES.get(version, ())
        for number in range(first, last + 1)
    }
    return frozenset(names & set(scenes))
