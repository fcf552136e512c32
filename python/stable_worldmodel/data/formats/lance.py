"""The format `lance`."""

from ..format import FORMATS
from .named import LanceDataset, LanceWriter

__all__ = ["Lance", "LanceDataset", "LanceWriter"]

Lance = FORMATS["lance"]
