"""The format `hdf5`."""

from ..format import FORMATS
from .named import HDF5Dataset, HDF5Writer

__all__ = ["HDF5", "HDF5Dataset", "HDF5Writer"]

HDF5 = FORMATS["hdf5"]
