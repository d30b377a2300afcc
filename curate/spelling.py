"""Suggestions for misspelled names."""

from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" with the known name closest to a word, "" if none is close.

    Case does not count, and neither does which of "-", "_" and " " separates words.
    """
    from difflib import get_close_matches

    by_key = {_key(name): name for name in known}
    found = get_close_matches(_key(word), by_key, n=1, cutoff=0.6)
    return f"; did you mean {by_key[found[0]]!r}?" if found else ""


def _key(name: str) -> str:
    return name.casefold().replace("_", "-").replace(" ", "-")
