"""LZF, the compression of PCD files.

Source: Lehmann, LibLZF. A byte below 32 announces that many literal bytes and one more; any other
byte a repetition of bytes already made, by its length (three bits, or a further byte) and distance.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def unpack(source: np.ndarray, target: np.ndarray) -> int:
    """Undo the compression of (n,) bytes into (m,) bytes.

    Returns:
        How many bytes it made; -1 where the source is damaged or makes more than m.
    """
    at, made = 0, 0
    while at < len(source):
        control = int(source[at])
        at += 1
        if control < 32:
            length = control + 1
            if at + length > len(source) or made + length > len(target):
                return -1
            for i in range(length):
                target[made + i] = source[at + i]
            at += length
        else:
            length = control >> 5
            if length == 7:
                if at >= len(source):
                    return -1
                length += int(source[at])
                at += 1
            if at >= len(source):
                return -1
            reference = made - ((control & 31) << 8) - int(source[at]) - 1
            at += 1
            length += 2
            if reference < 0 or made + length > len(target):
                return -1
            for i in range(length):
                target[made + i] = target[reference + i]
        made += length
    return made
