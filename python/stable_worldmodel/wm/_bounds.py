"""Bounds of the modules that a file describes: they are built only if the file with their weights is of their size."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torch import nn
from torch.nn.modules.module import register_module_buffer_registration_hook, register_module_parameter_registration_hook

__all__ = ["bounded"]

#: Elements of buffers and of modules whose weights are not stored, beside those of the file: half a gigabyte.
_FREE_ELEMENTS = 1 << 27
#: Their number.
_FREE_TENSORS = 4096


@contextmanager
def bounded(stored_bytes: int, stored_tensors: int) -> Iterator[None]:
    """Refuses modules of this thread that have more parameters and buffers than a file of this size can hold.

    Args:
        stored_bytes: The size of the file with the weights.
        stored_tensors: The number of tensors in it.

    Raises:
        ValueError: At the first parameter that is too much.
    """
    thread, elements, tensors = threading.get_ident(), 0, 0

    def check(module: nn.Module, name: str, value: Any) -> None:
        nonlocal elements, tensors
        if value is None or threading.get_ident() != thread:
            return
        elements, tensors = elements + value.numel(), tensors + 1
        if elements > stored_bytes + _FREE_ELEMENTS or tensors > stored_tensors + _FREE_TENSORS:
            raise ValueError(
                f"the configuration describes a larger model than the file of the weights holds ({stored_bytes} bytes, "
                f"{stored_tensors} tensors): {type(module).__name__}.{name} is one tensor too many; pass trust=True if you "
                "trust the files"
            )

    hooks = [register_module_parameter_registration_hook(check), register_module_buffer_registration_hook(check)]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()
