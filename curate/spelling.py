"""Suggestions for misspelled names."""

from collections.abc import Iterable


def did_you_mean(word: str, names: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" with the name most similar to `word`, "" if none is similar.

    The comparison ignores case and treats "-", "_" and " " as equal.
    """
    from difflib import get_close_matches

    by_key = {_key(name): name for name in names}
    closest = get_close_matches(_key(word), by_key, n=1, cutoff=0.6)
    return f"; did you mean {by_key[closest[0]]!r}?" if closest else ""


def _key(name: str) -> str:
    return name.casefold().replace("_", "-").replace(" ", "-")
