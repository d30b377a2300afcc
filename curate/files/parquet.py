"""Import of pyarrow, an optional dependency, at the time of use."""

from typing import Any

from curate.errors import ConfigError


def load_parquet() -> tuple[Any, Any]:
    """Return the modules pyarrow and pyarrow.parquet.

    Raises:
        ConfigError: if pyarrow is not installed.
    """
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise ConfigError(
            "Parquet needs pyarrow: pip install 'curate-pseudo-labels[parquet]'"
        ) from None
    return pa, parquet
