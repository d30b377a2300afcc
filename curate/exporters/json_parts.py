"""Write a large JSON document in parts, with only some items in memory at a time."""

import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryFile
from types import TracebackType
from typing import Any, Literal, Self

from pydantic_core import to_json

from curate.files.atomic import atomic_path
from curate.files.json_text import parse_json

_COPIED_BYTES = 1 << 20


class JsonParts:
    """A JSON document with some long lists or objects, to which items are added in any order.

    Each of these parts grows in a temporary file beside the document, and `finish` joins them.

    Args:
        path: the document; it is replaced as a whole, or stays as it is.
        names: the keys of the parts.
        kind: whether the parts are lists or objects.
    """

    def __init__(
        self, path: Path, names: Sequence[str], kind: Literal["lists", "objects"] = "lists"
    ) -> None:
        self._path = path
        self._names = names
        self._brackets = (b"[", b"]") if kind == "lists" else (b"{", b"}")
        self._counts = dict.fromkeys(names, 0)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._partial = stack.enter_context(atomic_path(self._path))
            folder = self._partial.parent
            self._files = {
                name: stack.enter_context(TemporaryFile(dir=folder)) for name in self._names
            }
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def next_id(self, name: str) -> int:
        """Return the number of the next item of a part, from 1."""
        return self._counts[name] + 1

    def add(self, name: str, items: Sequence[Any] | Mapping[str, Any]) -> None:
        """Append items of plain Python values to a part.

        Raises:
            DataError: if a number is not finite, which JSON cannot hold.
        """
        if items:
            separator = b"," if self._counts[name] else b""
            self._files[name].write(separator + self._json(items)[1:-1])
            self._counts[name] += len(items)

    def finish(self, before: Mapping[str, Any], after: Mapping[str, Any] | None = None) -> None:
        """Write the document: some keys, the parts, further keys."""
        opening, closing = self._brackets
        with self._partial.open("wb") as document:
            document.write(self._json(before)[:-1])
            for name, file in self._files.items():
                document.write(b"," + self._json(name) + b":" + opening)
                file.seek(0)
                shutil.copyfileobj(file, document, _COPIED_BYTES)
                document.write(closing)
            document.write(b"," + self._json(after)[1:] if after else b"}")

    def _json(self, value: Any) -> bytes:
        text = to_json(value, inf_nan_mode="constants")
        if b"NaN" in text or b"Infinity" in text:
            parse_json(text, self._path)  # they may also be part of a name
        return text
