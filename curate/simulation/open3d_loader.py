"""The one place that imports Open3D, and brings the shared library that its wheel leaves out.

Open3D's wheel links against `libusb-1.0.so.0`, which a bare Linux machine lacks. The package
`libusb-package` carries one; loaded with global visibility before the import, it satisfies the
linker without root.
"""

import ctypes
import re
import sys
from types import ModuleType

from curate.errors import ConfigError

_LIBUSB = "libusb-1.0.so.0"

# What the wheel links against, and the Debian/Ubuntu package that brings it.
_DEBIAN_PACKAGES = {
    _LIBUSB: "libusb-1.0-0",
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
    "libidn2.so.0": "libidn2-0",
    "libgomp.so.1": "libgomp1",
}


def load() -> ModuleType:
    """The module `open3d`, imported.

    Raises:
        ConfigError: Open3D is not installed, or a shared library that it needs is missing.
    """
    if "open3d" not in sys.modules and sys.platform == "linux":
        _provide_libusb()
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise ConfigError(_remedy(str(error))) from error
    return open3d


def _provide_libusb() -> None:
    """Make `libusb-1.0.so.0` known to the linker; the system's own is preferred.

    Where neither can be loaded, the import of Open3D that follows reports what is missing.
    """
    try:
        ctypes.CDLL(_LIBUSB, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError):
            return


def _remedy(reason: str) -> str:
    """One line: what is missing, and the command that brings it."""
    if "No module named 'open3d'" in reason:
        return "open3d is not installed: run `pip install open3d-cpu` (or `pip install open3d`)"
    missing = re.search(r"(lib[\w.+-]+?\.so[.\d]*): cannot open", reason)
    if missing is None:
        return f"open3d cannot be imported: {' '.join(reason.split())}"
    library = missing.group(1)
    package = _DEBIAN_PACKAGES.get(library)
    command = f"run `apt-get install {package}` as root" if package else "install it"
    return f"open3d needs the shared library {library}, which this machine lacks: {command}"
