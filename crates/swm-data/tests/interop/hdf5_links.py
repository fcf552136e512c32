"""Writes the HDF5 files `hdf5-links.h5`, `hdf5-linked-column.h5`, `hdf5-external-links.h5` and `hdf5-external-column.h5` beside
this file, whose root groups have links. Needs numpy and h5py.

    python hdf5_links.py
"""

from pathlib import Path

import h5py
import numpy as np

here = Path(__file__).parent


def begin(name, lengths="ep_len"):
    file = h5py.File(here / name, "w", libver=("earliest", "v110"))
    file[lengths] = np.full(3, 4, np.int32)
    file["ep_offset"] = (np.arange(3) * 4).astype(np.int64)
    file["state"] = np.arange(12, dtype=np.float32)
    return file


# Soft links to a dataset, a group and nothing.
with begin("hdf5-links.h5") as file:
    file["a group/inner"] = np.zeros(12, np.float32)
    file["alias"] = h5py.SoftLink("/state")
    file["inner"] = h5py.SoftLink("/a group/inner")
    file["shortcut"] = h5py.SoftLink("/a group")
    file["zzz nothing"] = h5py.SoftLink("/gone")
    file["hard alias"] = file["state"]

# The lengths of the episodes are behind a soft link.
with begin("hdf5-linked-column.h5", "lengths") as file:
    file["ep_len"] = h5py.SoftLink("/lengths")

# Links to other files, which h5py stores in a newer kind of group.
with begin("hdf5-external-links.h5") as file:
    file["elsewhere"] = h5py.ExternalLink("hdf5-links.h5", "/state")
    file["passwords"] = h5py.ExternalLink("/etc/passwd", "/")
    file["alias"] = h5py.SoftLink("/state")

with begin("hdf5-external-column.h5", "lengths") as file:
    file["ep_len"] = h5py.ExternalLink("hdf5-links.h5", "/ep_len")
