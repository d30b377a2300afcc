"""Category names: renamed by a mapping, and compared between two sides before work starts.

One side is always `dataset.categories`. The other side is what occurs in the label files, what a
detector returns, or what a segmenter has classes for. Example, with the categories Car and Cyclist:

    the other side    finding
    Car, Cyclist      none
    car, cyclist      wrong: no name is the same; dataset.rename={car="Car", cyclist="Cyclist"}
    Car, cyclist      wrong: the same name in another spelling
    Car, Bus          suspect: Bus is left out; Cyclist never occurs
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from curate.datasets.kitti.labels import DONT_CARE
from curate.detections import Annotations, Detections, as_categories
from curate.errors import ConfigError
from curate.files.toml_text import toml_key
from curate.spelling import closest, did_you_mean, letters

_LISTED = 6

Objects = TypeVar("Objects", Detections, Annotations)


@dataclass(frozen=True)
class NameFinding:
    """A difference between the names of two sides.

    Attributes:
        wrong: whether no work can start with it; otherwise it is a warning.
        message: what is on both sides, and the setting that would make them agree.
    """

    wrong: bool
    message: str


@dataclass(frozen=True)
class NamedSide:
    """The names of one side.

    Attributes:
        title: what has the names, such as "the label files".
        names: the names before renaming, or the number of objects of each.
        setting: the setting that renames them, such as "dataset.rename".
        rename: its value.
        accepted: names outside of `dataset.categories` that need no warning.
        original: whether these are all names before renaming; false if some are renamed already.
    """

    title: str
    names: Collection[str] | Mapping[str, int]
    setting: str
    rename: Mapping[str, str]
    accepted: Collection[str] = ()
    original: bool = True


def renamed(objects: Objects, rename: Mapping[str, str] | None) -> Objects:
    """Return detections or ground truth with renamed categories; other names stay unchanged."""
    if not rename:
        return objects
    names = [rename.get(name, name) for name in objects.categories.tolist()]
    return replace(objects, categories=as_categories(names))


def check_rename(rename: Mapping[str, str]) -> None:
    """Check that renaming twice is the same as renaming once.

    Raises:
        ConfigError: if a name is both renamed and the target of another one, or is DontCare, which
            has no boxes.
    """
    for source, target in rename.items():
        if rename.get(target, target) != target:
            raise ConfigError(
                f"{source!r} becomes {target!r}, which becomes {rename[target]!r}; write the final "
                "name of each"
            )
        if source == DONT_CARE != target:
            raise ConfigError(f"{DONT_CARE} cannot be renamed: its regions have no box")


def compare_names(side: NamedSide, categories: Sequence[str]) -> list[NameFinding]:
    """Return the differences between the names of a side and `dataset.categories`.

    A side without names has no differences.

    Args:
        side: see `NamedSide`.
        categories: `dataset.categories`.
    """
    found = {side.rename.get(name, name) for name in side.names} - {DONT_CARE}
    findings = _unused(side, categories)
    if not found:
        return findings
    unknown = sorted(found - set(categories))
    missing = [name for name in categories if name not in found]
    declared = f"dataset.categories are {listed(categories)}"
    if len(missing) == len(categories):
        problem = f"{side.title} have {_shown(side, unknown)}, but {declared}: no name is the same"
        return [NameFinding(True, f"{problem}; {_remedy(side, unknown, missing)}"), *findings]
    by_letters = {letters(name) for name in categories}
    other_letters = [name for name in unknown if letters(name) in by_letters]
    accepted = {*side.accepted, *(name for name, same in side.rename.items() if name == same)}
    if wrong := [name for name in other_letters if name not in accepted]:
        problem = f"{side.title} have {_shown(side, wrong)}, but {declared}, in another spelling"
        findings.append(NameFinding(True, f"{problem}; {_remedy(side, wrong, categories)}"))
    others = [name for name in unknown if name not in {*other_letters, *accepted}]
    if others:
        message = (
            f"{side.title} have {_shown(side, others)}, which dataset.categories does not list: "
            f"left out; {_remedy(side, others, missing)}"
        )
        findings.append(NameFinding(False, message))
    if missing:
        message = f"{side.title} have no {listed(missing)}, only {listed(sorted(found))}"
        findings.append(NameFinding(False, message))
    return findings


def mapping(unknown: Iterable[str], categories: Sequence[str]) -> dict[str, str]:
    """Return the most similar category of each unknown name; names without one are left out."""
    pairs = {name: closest(name, categories) for name in unknown}
    return {name: category for name, category in pairs.items() if category is not None}


def inline_table(rename: Mapping[str, str]) -> str:
    """Return a mapping of names as TOML, as it is written after `--set KEY=`."""
    pairs = (f'{toml_key(name)}="{category}"' for name, category in rename.items())
    return f"{{{', '.join(pairs)}}}"


def listed(names: Collection[str] | Mapping[str, int]) -> str:
    """Return names as "Car, Van", or with numbers as "Car 12, Van 3"; only the first of many."""
    numbers = names if isinstance(names, Mapping) else {}
    shown = [
        f"{name[:40]!s} {numbers[name]}" if name in numbers else name[:40]
        for name in list(names)[:_LISTED]
    ]
    more = len(names) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")


def _unused(side: NamedSide, categories: Sequence[str]) -> list[NameFinding]:
    """Return findings for names that are renamed but never occur, or to an unknown category."""
    findings = []
    never = [name for name in side.rename if name not in side.names]
    for name in never if side.original and side.names else ():
        message = f"{side.setting}: {side.title} have no {name!r}{did_you_mean(name, side.names)}"
        findings.append(NameFinding(False, message))
    known = {*categories, *side.accepted, DONT_CARE}
    for name, target in side.rename.items():
        if target not in known and target != name:
            message = f"{side.setting}: {target!r} is not in dataset.categories"
            findings.append(NameFinding(False, message + did_you_mean(target, categories)))
    return findings


def _shown(side: NamedSide, names: Collection[str]) -> str:
    """Return names, with the number of objects where it is known."""
    if not isinstance(side.names, Mapping):
        return listed(names)
    counts = dict.fromkeys(names, 0)
    for name, count in side.names.items():
        final = side.rename.get(name, name)
        if final in counts:
            counts[final] += count
    return listed(counts)


def _remedy(side: NamedSide, unknown: Sequence[str], categories: Sequence[str]) -> str:
    """Return the settings that would make the names agree."""
    similar = mapping(unknown, categories)
    example = similar or ({unknown[0]: categories[0]} if categories else {})
    if not example:
        return f"to use it, add {unknown[0]!r} to dataset.categories"
    such = "" if similar else ", for example"
    table = inline_table({**side.rename, **example})
    section = side.setting.partition(".")[0]
    return (
        f"map names with --set '{side.setting}={table}' at init, or rename = {table} in "
        f"[{section}] of curate.toml{such}; or change dataset.categories"
    )
