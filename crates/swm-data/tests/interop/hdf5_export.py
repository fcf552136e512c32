"""Writes the HDF5 files next to this script. h5py writes every filter, every layout and chunks in B-trees; the writer
of the reference implementation writes `hdf5-reference.h5`. Needs numpy, h5py, hdf5plugin, and for `reference` the
published `stable-worldmodel`.

    python hdf5_export.py            # hdf5-filters.h5, hdf5-layouts.h5, hdf5-trees.h5
    python hdf5_export.py reference  # also hdf5-reference.h5
"""

import sys
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np

here = Path(__file__).parent
lengths = [6, 7, 8]
rows = sum(lengths)


def images(height=6, width=8):
    t, y, x = np.mgrid[0:rows, 0:height, 0:width]
    return np.stack([10 * y + t, 4 * x + 7 * t, np.where((x + y) % 5 == 0, 200, 30)], -1).astype(np.uint8)


def values(dtype="f8"):
    t, k = np.mgrid[0:rows, 0:5]
    return (t * 100 + k * k).astype(dtype)


def begin(name, **options):
    file = h5py.File(here / name, "w", **options)
    file["ep_len"] = np.array(lengths, np.int32)
    file["ep_offset"] = np.cumsum([0, *lengths[:-1]])
    return file


def filters():
    blosc = {
        f"blosc-{codec}-{shuffle}": hdf5plugin.Blosc(cname=codec, clevel=5, shuffle=shuffle)
        for codec in ("blosclz", "lz4", "lz4hc", "zlib", "zstd")
        for shuffle in (0, 1, 2)
    }
    settings = {
        "gzip": {"compression": "gzip"},
        "gzip-shuffle-fletcher": {"compression": "gzip", "shuffle": True, "fletcher32": True},
        "lzf": {"compression": "lzf"},
        "lzf-shuffle": {"compression": "lzf", "shuffle": True},
        "fletcher": {"fletcher32": True},
        "lz4": hdf5plugin.LZ4(),
        "lz4-blocks": hdf5plugin.LZ4(nbytes=512),
        "zstd": hdf5plugin.Zstd(),
        "bitshuffle": hdf5plugin.Bitshuffle(cname="none"),
        "bitshuffle-lz4": hdf5plugin.Bitshuffle(cname="lz4"),
        "bitshuffle-zstd": hdf5plugin.Bitshuffle(cname="zstd"),
        **blosc,
    }
    with begin("hdf5-filters.h5", libver=("v110", "v110")) as file:
        for name, options in settings.items():
            file.create_dataset(f"numbers {name}", data=values(), chunks=(rows, 5), **options)
            file.create_dataset(f"pictures {name}", data=images(), chunks=(4, 6, 8, 3), **options)

    with begin("hdf5-snappy.h5", libver=("v110", "v110")) as file:
        for shuffle in (0, 1, 2):
            options = hdf5plugin.Blosc(cname="snappy", clevel=5, shuffle=shuffle)
            file.create_dataset(f"numbers {shuffle}", data=values(), chunks=(rows, 5), **options)
            file.create_dataset(f"pictures {shuffle}", data=images(), chunks=(4, 6, 8, 3), **options)
    with begin("hdf5-blosc2.h5", libver=("v110", "v110")) as file:
        file.create_dataset("numbers", data=values(), chunks=(rows, 5), **hdf5plugin.Blosc2())


def layouts():
    with begin("hdf5-layouts.h5", libver=("v110", "v110")) as file:
        file.create_dataset("contiguous", data=images())
        file.create_dataset("one chunk", data=images(), chunks=(rows, 6, 8, 3))
        file.create_dataset("fixed", data=images(), chunks=(2, 4, 5, 2))
        file.create_dataset("growing", data=images(), chunks=(1, 6, 8, 3), maxshape=(None, 6, 8, 3))
        file.create_dataset("growing blocks", data=images(), chunks=(3, 5, 8, 3), maxshape=(None, 6, 8, 3), compression="gzip")
        for dtype in ("i1", "u2", "i2", ">i4", "u4", "u8", "f2", ">f8"):
            file.create_dataset(f"numbers {dtype}", data=values(dtype) if dtype != "i1" else (values() % 100).astype("i1"))
        file["text"] = np.array([b"push"] * rows)
        file["truth"] = np.arange(rows) % 3 == 0
    with begin("hdf5-trees.h5") as file:
        file.create_dataset("growing", data=images(), chunks=(1, 6, 8, 3), maxshape=(None, 6, 8, 3))
        file.create_dataset("blocks", data=images(), chunks=(5, 4, 3, 3), compression="gzip")
        sparse = file.create_dataset("partly written", shape=(rows, 5), chunks=(4, 5), dtype="f8")
        sparse[:16] = values()[:16]


def reference():
    from stable_worldmodel.data.formats.hdf5 import HDF5Writer

    (here / "hdf5-reference.h5").unlink(missing_ok=True)
    with HDF5Writer(here / "hdf5-reference.h5", mode="overwrite") as writer:
        first = 0
        for length in lengths:
            part = slice(first, first + length)
            action = values("f4")[part, :2].copy()
            action[-1] = np.nan
            columns = {"pixels": images()[part], "action": action, "reward": values("f8")[part, 0], "step_idx": np.arange(length)}
            # Nine columns, because HDF5 stores more than eight names in another way.
            columns |= {f"variation.{k}": values("i8")[part, k] for k in range(5)}
            writer.write_episode({name: list(values) for name, values in columns.items()})
            first += length


filters()
layouts()
if "reference" in sys.argv:
    reference()
