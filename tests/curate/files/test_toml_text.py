"""TOML that would use up memory or time is rejected; everything else is read unchanged."""

import tomllib

import pytest

from curate.files.toml_text import MOST_CHARACTERS, MOST_PARTS, parse_toml, toml, toml_key


@pytest.mark.parametrize(
    "text",
    [
        f"{'a.' * 15_000}a = 1",
        f"[{'a.' * 15_000}a]",
        "x = {" + '"a" . ' * 15_000 + "a = 1}",
        "#" * (MOST_CHARACTERS + 1),
    ],
)
def test_text_with_quadratic_cost_is_rejected(text: str) -> None:
    """Keys of many parts, in any notation, and texts without end."""
    with pytest.raises(ValueError, match="more than"):
        parse_toml(text)


@pytest.mark.parametrize(
    "text",
    [
        f"{'a.' * (MOST_PARTS - 1)}a = 1",
        f"x = [{'0.5, ' * 1000}]",
        f"x = '{'A sentence of words. ' * 1000}'",
        f"x = '''{chr(10).join(['1.5'] * 1000)}'''",
    ],
)
def test_ordinary_documents_are_read(text: str) -> None:
    """Dots in numbers and sentences are not keys."""
    assert parse_toml(text) == tomllib.loads(text)


@pytest.mark.parametrize("text", ["a" * 1_000_000, "'" * 999_999, '"' * 999_999, "a\t" * 400_000])
def test_the_check_itself_is_fast(text: str) -> None:
    """A backtracking pattern would not end."""
    with pytest.raises(tomllib.TOMLDecodeError):
        parse_toml(text)


def test_a_byte_order_mark_is_ignored() -> None:
    """Some editors write one."""
    assert parse_toml("\ufeffa = 1\n") == {"a": 1}


@pytest.mark.parametrize(
    "value",
    [
        True,
        3,
        -0.5,
        1e-9,
        'quotes " and \\ and a line\nbreak, \x7f and \x01',
        ["a", ["b"], {"c d": {"e:f": 1.0}}],
        {},
    ],
)
def test_written_values_are_read_back(value: object) -> None:
    """All values that the configuration can contain."""
    assert parse_toml(f"x = {toml(value)}") == {"x": value}


@pytest.mark.parametrize(("key", "written"), [("a-b_1", "a-b_1"), ("a.b", '"a.b"'), ("", '""')])
def test_a_key_is_quoted_if_necessary(key: str, written: str) -> None:
    assert toml_key(key) == written
    assert parse_toml(f"{toml_key(key)} = 1") == {key: 1}
