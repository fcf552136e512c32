"""Files of weights: safetensors, and state dicts of torch whose names differ between versions of `transformers`."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import pickle
import re
import struct
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .pretrained import stored_names

__all__ = ["check_archive", "check_numbers", "lacks_memory", "load_into", "read_capsule", "read_safetensors", "read_state_dict"]

_TYPES = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "I64": "<i8", "I32": "<i4", "U8": "u1", "BOOL": "?"}
#: The types of weights in which NaN are looked for.
_WITH_NAN = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
#: The largest header of a file, in bytes.
_MAX_HEADER = 100_000_000

#: The attribute of a member of an archive that is a folder, and the flag of one that is encrypted.
_FOLDER, _ENCRYPTED = 0x10, 0x1

#: Parts of the weight names of a vision transformer: in `transformers` 5, then as published.
_NEWER = (
    (".layers.", ".encoder.layer."),
    (".attention.q_proj.", ".attention.attention.query."),
    (".attention.k_proj.", ".attention.attention.key."),
    (".attention.v_proj.", ".attention.attention.value."),
    (".attention.o_proj.", ".attention.output.dense."),
    (".mlp.fc1.", ".intermediate.dense."),
    (".mlp.fc2.", ".output.dense."),
)


def read_safetensors(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """The tensors of a safetensors file.

    Raises:
        RuntimeError: If the file is damaged.
    """
    return _read(path)[0]


def read_capsule(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The document of a capsule of the engine, and its weights in single precision.

    Raises:
        RuntimeError: If the file is no capsule, or damaged.
    """
    tensors, metadata = _read(path)
    if "swm_capsule" not in metadata:
        raise RuntimeError(f"{path}: it is no capsule; expected a file that `swm checkpoints pack` wrote")
    with _damage(path):
        document = json.loads(metadata["swm_capsule"])
    return document, {name: value.float() for name, value in tensors.items() if "/" not in name}


def lacks_memory(error: Exception) -> bool:
    """Whether an error says that there is too little memory; torch has no type of its own for that of the CPU."""
    return isinstance(error, MemoryError) or bool(re.search("(?i)out of memory|allocate memory", str(error)))


@contextlib.contextmanager
def _damage(path: str | os.PathLike[str]) -> Iterator[None]:
    """Raises what the content of a damaged file leads to as a `RuntimeError` that names the file."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        problem = f"{type(error).__name__}: {error}"
        raise RuntimeError(f"{path}: it is damaged ({problem}); get it again from where it comes from") from error


def _read(path: str | os.PathLike[str]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """The tensors and the metadata of a safetensors file."""
    _check_not_sparse(path)
    with open(path, "rb") as file, _damage(path):
        size = os.fstat(file.fileno()).st_size
        (length,) = struct.unpack("<Q", file.read(8).ljust(8, b"\0"))
        if not 0 < length <= min(_MAX_HEADER, size - 8):
            raise RuntimeError(f"{path}: not a safetensors file")
        header = json.loads(file.read(length))
        data = file.read()
        metadata = dict(header.pop("__metadata__", None) or {})
        found = {}
        for name, entry in header.items():
            begin, end = entry["data_offsets"]
            if entry["dtype"] not in _TYPES or not 0 <= begin <= end <= len(data):
                raise RuntimeError(f"{path}: the tensor {name!r} is damaged or of an unknown type")
            values = np.frombuffer(data[begin:end], np.dtype(_TYPES[entry["dtype"]])).reshape(entry["shape"])
            found[name] = torch.from_numpy(values.copy())
    return found, metadata


def read_state_dict(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """The tensors of a file that `torch.save` wrote, or of a safetensors file. No code of the file runs.

    Raises:
        RuntimeError: If the file is damaged, or has other objects than tensors, numbers and texts.
    """
    if Path(path).suffix == ".safetensors":
        return read_safetensors(path)
    _check_not_sparse(path)
    check_archive(path)
    try:
        found: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        if _is_of_system(error) or lacks_memory(error):
            raise
        named = re.search(r"GLOBAL (\S+)", str(error)) if isinstance(error, pickle.UnpicklingError) else None
        if named is not None:
            # What torch says to do here would run code of the file.
            raise RuntimeError(
                f"{path}: it holds objects of {named[1]!r}, and only tensors, numbers and texts are read (weights_only); save "
                "its state dict alone, or import it with `swm checkpoints import`"
            ) from error
        # For damage torch raises errors of many types, and few of them name the file.
        reason = str(error).rpartition("WeightsUnpickler error: ")[2].strip().partition("\n")[0]
        raise RuntimeError(
            f"{path}: torch cannot load it ({reason or type(error).__name__}); expected a whole file that torch.save wrote"
        ) from error
    if isinstance(found, Mapping) and isinstance(found.get("state_dict"), Mapping):
        found = found["state_dict"]
    if not isinstance(found, Mapping) or not all(torch.is_tensor(value) for value in found.values()):
        raise RuntimeError(f"{path}: expected a state dict, a dict of tensors")
    return dict(found)


def check_numbers(weights: Mapping[str, Tensor], source: str) -> None:
    """Refuses weights with NaN, as `swm checkpoints import` does. Masks may be infinite.

    Raises:
        RuntimeError: If a tensor has one.
    """
    for name, value in weights.items():
        if value.dtype in _WITH_NAN and value.layout == torch.strided and bool(value.isnan().any()):
            raise RuntimeError(f"{source}: {name!r} has NaN; give weights of a training that did not diverge")


def _check_not_sparse(path: str | os.PathLike[str]) -> None:
    """Refuses a long sparse file, as the engine does: reading it would take memory for its full length.

    Raises:
        RuntimeError: If a file of more than 64 MiB takes less than a 64th of its length on the disk.
    """
    found = os.stat(path)
    taken = found.st_blocks * 512
    if found.st_size <= 64 << 20 or taken >= found.st_size // 64:
        return
    with open(path, "rb") as file:
        # Some file systems do not say what a file takes; then it does not begin with nothing.
        if taken == 0 and any(file.read(4096)):
            return
    size = f"{found.st_size} bytes long, of which {taken} are on the disk"
    raise RuntimeError(f"{path}: it is a sparse file, {size}; get it again from where it comes from")


def check_archive(path: str | os.PathLike[str]) -> None:
    """Refuses an archive with compressed members, which `torch.save` does not write and which may be of any size, and one whose
    members differ from their checksums, which `torch.load` does not compare.

    Raises:
        RuntimeError: If a member is compressed or damaged.
    """
    try:
        if not zipfile.is_zipfile(path):
            return
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if len(set(names)) < len(names):
                twice = next(name for name in names if names.count(name) > 1)
                raise RuntimeError(f"{path}: {twice!r} is in it twice; get the file again from where it comes from")
            for member in archive.infolist():
                if member.compress_type != zipfile.ZIP_STORED:
                    raise RuntimeError(f"{path}: {member.filename!r} is compressed; expected a file that torch.save wrote")
                # Of such members, torch reads nothing, and returns what was in the memory before.
                plain = not (member.external_attr & _FOLDER or member.flag_bits & _ENCRYPTED)
                if not plain or member.compress_size != member.file_size:
                    problem = f"{member.filename!r} is not stored as a plain file"
                    raise RuntimeError(f"{path}: {problem}; get the file again from where it comes from")
            # torch can leave out the checksums (`torch.serialization.set_crc32_options`).
            damaged = archive.testzip() if any(member.CRC for member in archive.infolist()) else None
    except (zipfile.BadZipFile, ValueError, EOFError, NotImplementedError, OSError) as error:
        if _is_of_system(error):
            raise
        raise RuntimeError(f"{path}: it is damaged ({error}); get it again from where it comes from") from error
    if damaged is not None:
        raise RuntimeError(f"{path}: {damaged!r} is damaged, its checksum differs; get the file again from where it comes from")


def _is_of_system(error: Exception) -> bool:
    """Whether the system could not read a file. Positions that no file has are those of a damaged archive."""
    return isinstance(error, OSError) and error.errno != errno.EINVAL


def load_into(model: nn.Module, weights: Mapping[str, Tensor], source: str) -> None:
    """Loads weights, renaming those of a vision transformer that `transformers` 5 saved.

    Raises:
        RuntimeError: If a weight is missing, unexpected, complex, of another shape, or given under two names.
    """
    names: dict[str, str] = {}
    for name, value in weights.items():
        first = names.setdefault(published(name), name)
        if first != name:
            raise RuntimeError(f"{source}: {first!r} and {name!r} are two names of one weight; leave one out")
        if value.is_complex():
            raise RuntimeError(f"{source}: the weight {name!r} is {value.dtype}; expected real numbers")
    weights = {known: weights[name] for known, name in names.items()}
    expected = model.state_dict()
    missing = [name for name in stored_names(model) if name not in weights]
    unexpected = [name for name in weights if name not in expected]
    if missing or unexpected:
        raise RuntimeError(
            f"{source}: the weights do not fit {type(model).__name__}: missing {missing[:5]}, unexpected {unexpected[:5]}"
        )
    try:
        model.load_state_dict(dict(weights), strict=False)
    except RuntimeError as error:
        raise RuntimeError(f"{source}: the weights do not fit {type(model).__name__}: {error}") from error


def published(name: str) -> str:
    """The published name of a weight of an encoder; other names unchanged."""
    if not name.startswith("encoder.layers."):
        return name
    for newer, older in _NEWER:
        name = name.replace(newer, older, 1)
    return name
