"""Sparse 3D convolution in plain torch: nothing is compiled but numba kernels, at first use."""

from curate.detectors.openpcdet.sparse.convolution import (
    InverseConvolution,
    SparseTensor,
    StridedConvolution,
    SubmanifoldConvolution,
)
from curate.detectors.openpcdet.sparse.sites import Sites

__all__ = [
    "InverseConvolution",
    "Sites",
    "SparseTensor",
    "StridedConvolution",
    "SubmanifoldConvolution",
]
