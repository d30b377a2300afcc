"""Typical damage of external files: truncated, flipped, repeated, with absurd numbers."""

import struct
from collections.abc import Callable

Choose = Callable[[int, int], int]
"""A number from the first to the last, both included: of Hypothesis, random, or a fuzzer."""

TOKENS = (
    b"nan", b"inf", b"-inf", b"1e309", b"-1e308", b"1e-320", b"-1", b"0", b"9" * 400, b"0x10",
    b"9" * 5000, b"4294967296", b"9223372036854775807", b"\x00", b"\n", b"\r", b" ", b":", b",",
    b"../../../etc/passwd", b"/etc/passwd", b"[" * 3000, b"{" * 3000, b'"', b"\xff\xfe", b"\xc3",
    "\N{ARABIC-INDIC DIGIT FIVE}".encode(), b"=", b"#", b"true", b"[]", b"{}", b"None",
)  # fmt: skip
NUMBERS = tuple(
    struct.pack(form, number)
    for form, numbers in (
        ("<f", (float("nan"), float("inf"), 3e38, -3e38, 1e-44)),
        ("<d", (float("nan"), 1e308)),
        ("<i", (-1, 2**31 - 1, -(2**31), 0)),
        ("<q", (-1, 2**63 - 1, 2**40, 0)),
        (">i", (2**31 - 1, 65536)),
        ("<h", (-1, 2**15 - 1)),
    )
    for number in numbers
)


def mutated(content: bytes, choose: Choose) -> bytes:
    """Return the content after one to four kinds of damage; rarely something else altogether."""
    if choose(0, 40) == 0:
        return bytes(choose(0, 255) for _ in range(choose(0, 64)))
    for _ in range(choose(1, 4)):
        content = _DAMAGES[choose(0, len(_DAMAGES) - 1)](content, choose)
    return content


def _truncated(content: bytes, choose: Choose) -> bytes:
    return content[: choose(0, len(content))]


def _flipped(content: bytes, choose: Choose) -> bytes:
    damaged = bytearray(content)
    for _ in range(min(choose(1, 8), len(damaged))):
        damaged[choose(0, len(damaged) - 1)] ^= 1 << choose(0, 7)
    return bytes(damaged)


def _head_changed(content: bytes, choose: Choose) -> bytes:
    """Change one of the first bytes, which usually contain the header."""
    damaged = bytearray(content)
    if damaged:
        damaged[choose(0, min(len(damaged), 256) - 1)] = choose(0, 255)
    return bytes(damaged)


def _overwritten(content: bytes, choose: Choose) -> bytes:
    number = NUMBERS[choose(0, len(NUMBERS) - 1)]
    at = choose(0, len(content))
    return content[:at] + number + content[at + len(number) :]


def _inserted(content: bytes, choose: Choose) -> bytes:
    token = TOKENS[choose(0, len(TOKENS) - 1)]
    at = choose(0, len(content))
    return content[:at] + token + content[at:]


def _word_replaced(content: bytes, choose: Choose) -> bytes:
    words = content.split(b" ")
    words[choose(0, len(words) - 1)] = TOKENS[choose(0, len(TOKENS) - 1)]
    return b" ".join(words)


def _cut_out(content: bytes, choose: Choose) -> bytes:
    start = choose(0, len(content))
    return content[:start] + content[start + choose(0, 64) :]


def _repeated(content: bytes, choose: Choose) -> bytes:
    start = choose(0, len(content))
    piece = content[start : start + choose(1, 64)]
    return content[:start] + piece * choose(2, 4) + content[start:]


_DAMAGES = (
    _truncated,
    _flipped,
    _head_changed,
    _overwritten,
    _inserted,
    _word_replaced,
    _cut_out,
    _repeated,
)
