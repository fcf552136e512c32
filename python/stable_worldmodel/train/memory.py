"""Memory of a GPU: `sized` finds the largest batch that fits, and `explained` says what to lower if a batch does not."""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch

from .options import Options

__all__ = ["AUTO", "explained", "sized"]

#: The setting that asks for the largest batch.
AUTO = "data.batch_size=auto"
#: The share of the device's memory that a batch may take; the rest is for fragments and for other programs.
_SHARE = 0.9
#: The batches whose memory is measured, in clips.
_SMALL, _LARGE = 8, 32
#: The largest batch that is tried.
_MOST = 65_536


def sized(options: Options) -> Options:
    """The options with the largest batch that fits, a multiple of eight clips, if they ask for it.

    Two steps with small batches are measured; the memory of a step grows linearly with the batch. The batch that follows is
    tried, and made smaller while it does not fit. Compiled networks take less memory than these, which are not compiled.

    Raises:
        ValueError: If the device is no NVIDIA GPU, or the dataset has too few clips.
    """
    if AUTO not in options.settings:
        return options
    device = torch.device(options.device if options.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu")
    if device.type != "cuda":
        raise ValueError(f"{AUTO}: the memory of {device} is not measured; give a number, or train on an NVIDIA GPU")
    total = torch.cuda.get_device_properties(device).total_memory
    free = torch.cuda.mem_get_info(device)[0]
    most = _SHARE * min(free, total)
    small, large = (_peak(options, size, device) for size in (_SMALL, _LARGE))
    if small is None or large is None:
        raise ValueError(f"{AUTO}: {_LARGE} clips do not fit in {free / 2**30:.1f} GiB; choose a smaller model or image")
    each = max((large - small) / (_LARGE - _SMALL), 1.0)
    size = min(int(_SMALL + (most - small) / each), _MOST)
    while True:
        size = max(size // 8 * 8, _LARGE)
        peak = large if size == _LARGE else _peak(options, size, device)
        if peak is not None:
            break
        size = int(0.9 * size)
    sys.stderr.write(f"{AUTO}: {size} clips take {peak / 2**30:.1f} of {total / 2**30:.1f} GiB\n")
    return dataclasses.replace(options, settings=_with(options, f"data.batch_size={size}"))


@contextlib.contextmanager
def explained(options: Options) -> Iterator[None]:
    """Adds to the error of a full memory which settings to lower."""
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        first = str(error).split(". ")[0]
        given = next((setting for setting in options.settings if setting.startswith("data.batch_size=")), "data.batch_size")
        raise RuntimeError(
            f"{first}; lower {given} and raise optim.accumulate, compute in half precision (amp=bf16), or let {AUTO} "
            "choose; the last checkpoint is kept"
        ) from error


def _with(options: Options, *settings: str) -> list[str]:
    """The settings with others in place of the batch and of those that these name."""
    names = {"data.batch_size", *(setting.partition("=")[0] for setting in settings)}
    return [setting for setting in options.settings if setting.partition("=")[0] not in names] + list(settings)


def _peak(options: Options, size: int, device: torch.device) -> int | None:
    """The most memory that two steps with batches of `size` clips take; `None` if they do not fit."""
    from .loop import Trainer

    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    settings = [f"data.batch_size={size}", "schedule.steps=2", "schedule.warmup=0", "validation.every=0", "save_every=0"]
    with tempfile.TemporaryDirectory() as folder:
        out, settings = str(Path(folder) / "run"), _with(options, *settings)
        try:
            Trainer(dataclasses.replace(options, out=out, compile=False, resume=False, settings=settings)).train()
        except torch.cuda.OutOfMemoryError:
            return None
    return torch.cuda.max_memory_reserved(device)
