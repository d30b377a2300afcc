"""Import of open3d, with the system libraries that its wheel does not contain.

No other module imports open3d. Its wheel links against `libusb-1.0.so.0`, which a minimal Linux
system does not have. The package `libusb-package` contains it; if it is loaded with global
visibility before the import of open3d, the linker finds it. The other libraries must be installed
on the system, see `system_libraries`.
"""

import ctypes
import sys
from types import ModuleType

from curate.errors import ConfigError
from curate.simulation.system_libraries import DEBIAN_PACKAGES, missing_libraries

_LIBUSB = "libusb-1.0.so.0"


def load() -> ModuleType:
    """Import and return the module `open3d`.

    Raises:
        ConfigError: if open3d is not installed, or a system library that it needs is missing.
    """
    if "open3d" not in sys.modules and sys.platform == "linux":
        _provide_libusb()
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise ConfigError(
            f"simulation needs open3d, which cannot be loaded: {_remedy(error)}. "
            "Work on your own data does not need it"
        ) from error
    return open3d


def _provide_libusb() -> None:
    """Load `libusb-1.0.so.0` from the system, or else from `libusb-package`.

    If neither can be loaded, the import of open3d that follows reports the error.
    """
    try:
        ctypes.CDLL(_LIBUSB, mode=ctypes.RTLD_GLOBAL)
    except OSError:
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError):
            return


def _remedy(error: ImportError | OSError) -> str:
    """Return one line that says what is missing and which command installs it."""
    if isinstance(error, ModuleNotFoundError) and error.name == "open3d":
        return "it is not installed; run `pip install open3d-cpu` (or `pip install open3d`)"
    missing = missing_libraries()
    if not missing:
        return " ".join(str(error).split())
    packages = " ".join(DEBIAN_PACKAGES[name] for name in missing)
    return f"the system lacks {', '.join(missing)}; run `apt-get install {packages}` as root"
