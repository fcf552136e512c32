"""Writes hdf5-unwritten.h5: columns with rows that were never written, and an enumeration of two other numbers.

Run it in this folder with h5py. `external.h5` has a column whose values are in another file.
"""

import h5py
import numpy as np

ROWS = 12


def episodes(file):
    file["ep_len"] = np.full(3, 4, np.int32)
    file["ep_offset"] = (np.arange(3) * 4).astype(np.int64)
    file["state"] = np.arange(ROWS, dtype=np.float32)


with h5py.File("hdf5-unwritten.h5", "w", libver=("earliest", "v110")) as file:
    episodes(file)
    file.create_dataset("absent", (ROWS, 2), "f4", fillvalue=7.5)
    half = file.create_dataset("half", (ROWS,), ">i2", chunks=(4,), fillvalue=-3)
    half[4:8] = np.arange(4)
    file.create_dataset("zero", (ROWS,), "f8", chunks=(4,))[:4] = 1.0
    file.create_dataset("choice", data=np.arange(ROWS) % 2 + 1, dtype=h5py.enum_dtype({"ONE": 1, "TWO": 2}, basetype="i1"))
    file.create_dataset("halves", (ROWS,), "f2", chunks=(4,), fillvalue=3.0)[:4] = 0.5
    file.create_dataset("true", (ROWS,), "?", chunks=(4,), fillvalue=True)[4:8] = False
    file.create_dataset("flag", data=np.arange(ROWS) % 2 == 1)

with h5py.File("hdf5-external.h5", "w", libver=("earliest", "v110")) as file:
    episodes(file)
    file.create_dataset("reward", (ROWS,), "f4", external=[("values.raw", 0, 4 * ROWS)])
