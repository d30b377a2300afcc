"""Suggestions for misspelled names."""

from collections.abc import Iterable


def did_you_mean(word: str, names: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" with the name most similar to `word`, "" if none is similar.

    The comparison ignores case and treats "-", "_" and " " as equal.
    """
    found = closest(word, names)
    return "" if found is None else f"; did you mean {found!r}?"


def closest(word: str, names: Iterable[str]) -> str | None:
    """Return the name most similar to `word`, as `did_you_mean` compares; None if none is."""
    from difflib import get_close_matches

    by_key = {letters(name): name for name in names}
    found = get_close_matches(letters(word), by_key, n=1, cutoff=0.6)
    return by_key[found[0]] if found else None


def letters(name: str) -> str:
    """Return the form in which names are compared: lower case, with "-" for "_" and " "."""
    return name.casefold().replace("_", "-").replace(" ", "-")
