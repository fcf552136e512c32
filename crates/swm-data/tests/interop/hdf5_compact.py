"""Writes `hdf5-compact.h5` beside this file: columns whose data are in the headers of the datasets."""

import pathlib

import h5py
import numpy as np

columns = {
    "ep_len": np.array([3, 2], np.int32),
    "ep_offset": np.array([0, 3], np.int64),
    "step_idx": np.array([0, 1, 2, 0, 1], np.int64),
    "action": np.array([[0.5], [0.25], [np.nan], [1], [np.nan]], np.float32),
    "pixels": np.arange(5 * 2 * 2 * 3, dtype=np.uint8).reshape(5, 2, 2, 3),
}
with h5py.File(pathlib.Path(__file__).with_name("hdf5-compact.h5"), "w") as file:
    for name, values in columns.items():
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_layout(h5py.h5d.COMPACT)
        space = h5py.h5s.create_simple(values.shape)
        dataset = h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(values.dtype), space, settings)
        dataset.write(h5py.h5s.ALL, h5py.h5s.ALL, values)
