"""TOML that would take the memory or the time is rejected; everything else is read as it is."""

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
def test_what_grows_by_its_square_is_rejected(text: str) -> None:
    """Keys of many parts, however they are written, and texts without end."""
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
    """Points in numbers and sentences make no key."""
    assert parse_toml(text) == tomllib.loads(text)


@pytest.mark.parametrize("text", ["a" * 1_000_000, "'" * 999_999, '"' * 999_999, "a\t" * 400_000])
def test_the_look_itself_takes_no_time(text: str) -> None:
    """It ends, where a pattern that goes back and forth would not."""
    with pytest.raises(tomllib.TOMLDecodeError):
        parse_toml(text)


def test_a_mark_in_front_of_the_text_is_not_a_part_of_it() -> None:
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
def test_what_is_written_is_read_again(value: object) -> None:
    """Whatever the configuration can hold."""
    assert parse_toml(f"x = {toml(value)}") == {"x": value}


@pytest.mark.parametrize(("key", "written"), [("a-b_1", "a-b_1"), ("a.b", '"a.b"'), ("", '""')])
def test_a_key_is_in_quotes_where_it_must_be(key: str, written: str) -> None:
    """So that it stays one key."""
    assert toml_key(key) == written
    assert parse_toml(f"{toml_key(key)} = 1") == {key: 1}
