"""Shapes in signatures: `Float[np.ndarray, "n 7"]`, by jaxtyping.

They say something to readers, to the page of the Python API and to `make shapes`. A command that
reads a row should not wait for them: jaxtyping is used where it is loaded already, as by its import
hook, and otherwise `Annotated`, which is what it is to type checkers as well.
"""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import Bool, Float, Float32, Int, Num, Shaped, UInt8
else:
    from typing import Annotated

    Bool = Float = Float32 = Int = Num = Shaped = UInt8 = Annotated

__all__ = ["Bool", "Float", "Float32", "Int", "Num", "Shaped", "UInt8"]
