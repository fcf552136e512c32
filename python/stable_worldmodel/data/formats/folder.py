"""The format `folder`."""

from ..format import FORMATS
from .named import FolderDataset, FolderWriter, ImageDataset

__all__ = ["Folder", "FolderDataset", "FolderWriter", "ImageDataset"]

Folder = FORMATS["folder"]
