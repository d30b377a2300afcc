"""Decompression of LZF, which PCD files use.

Source: Lehmann, LibLZF. The data are a series of two kinds of blocks:

- A control byte c below 32 is followed by c + 1 literal bytes.
- Any other control byte repeats earlier output. Its upper three bits are the length minus 2; the
  value 7 means that a further byte is added to it. Its lower five bits and the next byte are the
  distance minus 1, high bits first.

Example: 02 'a' 'b' 'c' 20 02 is "abc" and then a repetition of length 1 + 2 = 3 at distance 2 + 1 =
3 before the end, so "abcabc".
"""

import numpy as np
from numba import njit


@njit(cache=True)
def unpack(source: np.ndarray, target: np.ndarray) -> int:
    """Decompress (n,) bytes into a target of (m,) bytes.

    Returns:
        The number of bytes written; -1 if the source is damaged or needs more than m bytes.
    """
    offset, written = 0, 0
    while offset < len(source):
        control = int(source[offset])
        offset += 1
        if control < 32:
            length = control + 1
            if offset + length > len(source) or written + length > len(target):
                return -1
            for i in range(length):
                target[written + i] = source[offset + i]
            offset += length
        else:
            length = control >> 5
            if length == 7:
                if offset >= len(source):
                    return -1
                length += int(source[offset])
                offset += 1
            if offset >= len(source):
                return -1
            reference = written - ((control & 31) << 8) - int(source[offset]) - 1
            offset += 1
            length += 2
            if reference < 0 or written + length > len(target):
                return -1
            for i in range(length):
                target[written + i] = target[reference + i]
        written += length
    return written
