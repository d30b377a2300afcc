"""The only module that imports open3d, and the system libraries that its wheel leaves out.

The wheel links against `libusb-1.0.so.0`, which a minimal Linux system lacks. The package
`libusb-package` contains it; loaded with global visibility before the import, it satisfies the
linker. The other libraries come from the system, see `system_libraries`.
"""

import ctypes
import sys
from types import ModuleType

from curate.errors import ConfigError
from curate.simulation.system_libraries import DEBIAN_PACKAGES, missing_libraries

_LIBUSB = "libusb-1.0.so.0"


def load() -> ModuleType:
    """Return the module `open3d`, imported.

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
            "Everything on your own data works without it"
        ) from error
    return open3d


def _provide_libusb() -> None:
    """Load `libusb-1.0.so.0`: the system's own if there is one, else the one of the package.

    If neither can be loaded, the import of open3d that follows reports it.
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
    """Return what is missing and the command that installs it, in one line."""
    if isinstance(error, ModuleNotFoundError) and error.name == "open3d":
        return "it is not installed; run `pip install open3d-cpu` (or `pip install open3d`)"
    missing = missing_libraries()
    if not missing:
        return " ".join(str(error).split())
    packages = " ".join(DEBIAN_PACKAGES[name] for name in missing)
    return f"the system lacks {', '.join(missing)}; run `apt-get install {packages}` as root"
