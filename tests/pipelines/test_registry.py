"""Classes that a user names, whatever their modules do."""

from pathlib import Path

import pytest

from curate.errors import ConfigError
from pipelines.registry import DETECTORS


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("raise RuntimeError('no\\nlicence')", "raises RuntimeError: no licence"),
        ("raise SystemExit(0)", "raises SystemExit: 0"),
        ("def f(", "raises SyntaxError"),
        ("Mine = 3", "is no class but 3"),
        ("", "cannot be imported"),
    ],
)
def test_a_module_that_cannot_be_used_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str, words: str
) -> None:
    """One line, and above all no exit status 0 as if all had been done."""
    name = f"of_a_user_{abs(hash(source))}"
    (tmp_path / f"{name}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=f"^detector '{name}:Mine' .*{words}") as found:
        DETECTORS.load(f"{name}:Mine")
    assert "\n" not in str(found.value)
