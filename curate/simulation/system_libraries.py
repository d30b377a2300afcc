"""The system libraries that open3d links against, and a check for missing ones.

This module uses only the standard library: `.ci/check_system.py` runs it before anything is
installed.
"""

import ctypes
import sys

DEBIAN_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libidn2.so.0": "libidn2-0",
    "libstdc++.so.6": "libstdc++6",
    "libudev.so.1": "libudev1",
}
"""The package of each library in Debian 12 and 13; Ubuntu 22.04 and 24.04 use the same names.

libusb-1.0 is not in the table, because `libusb-package` from PyPI contains it.
"""


def missing_libraries() -> list[str]:
    """Return the libraries that cannot be loaded; none on systems other than Linux."""
    return [name for name in DEBIAN_PACKAGES if sys.platform == "linux" and not loads(name)]


def loads(library: str) -> bool:
    """Return whether the dynamic linker finds a library."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
