"""The inverse of reading COCO's run lengths: masks to runs, and runs to the compressed string."""

from itertools import groupby


def runs(mask):
    """Return lengths of equal pixels down the columns, starting with a run outside."""
    height, width = len(mask), len(mask[0])
    pixels = [bool(mask[row][column]) for column in range(width) for row in range(height)]
    found = [(value, len(list(group))) for value, group in groupby(pixels)]
    return [length for _, length in found] if not found[0][0] else [0, *(n for _, n in found)]


def compress(lengths):
    """Return five bits per character, with a continuation bit; two's complement."""
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
    """Return whether the centre of a pixel is inside, by the even-odd rule along a ray."""
    x, y = column + 0.5, row + 0.5
    corners = list(zip(polygon[::2], polygon[1::2], strict=True))
    inside = False
    for (x0, y0), (x1, y1) in zip(corners, corners[1:] + corners[:1], strict=True):
        if (y0 > y) != (y1 > y):
            inside ^= x < (x1 - x0) * (y - y0) / (y1 - y0) + x0
    return inside
