"""COCO's run lengths the other way round: masks to runs, and runs to the compressed string."""

from itertools import groupby


def runs(mask):
    """Lengths of equal pixels down the columns, the first of them outside."""
    height, width = len(mask), len(mask[0])
    pixels = [bool(mask[row][column]) for column in range(width) for row in range(height)]
    found = [(value, len(list(group))) for value, group in groupby(pixels)]
    return [length for _, length in found] if not found[0][0] else [0, *(n for _, n in found)]


def compress(lengths):
    """Five bits a character, the sixth says that more follow; two's complement."""
    text = ""
    for place, length in enumerate(lengths):
        number = length - (lengths[place - 2] if place > 2 else 0)
        bits = 5
        while not -(2 ** (bits - 1)) <= number < 2 ** (bits - 1):
            bits += 5
        number %= 2**bits
        for start in range(0, bits, 5):
            more = 32 if start + 5 < bits else 0
            text += chr(48 + (number // 2**start) % 32 + more)
    return text


def centre_inside(polygon, column, row):
    """Whether the centre of a pixel lies inside by the winding of single rays (even-odd)."""
    x, y = column + 0.5, row + 0.5
    corners = list(zip(polygon[::2], polygon[1::2], strict=True))
    inside = False
    for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
        if (y0 > y) != (y1 > y):
            inside ^= x < (x1 - x0) * (y - y0) / (y1 - y0) + x0
    return inside
