"""PyTorch, where a program has imported it: the package itself does so only when it needs tensors."""

from __future__ import annotations

import sys
from typing import Any


def loaded() -> Any:
    """The module `torch` if it is imported; `None` if not, so that no value is a tensor.

    A thread may see the module while another one imports it, without its classes.
    """
    torch = sys.modules.get("torch")
    return torch if hasattr(torch, "Tensor") and hasattr(torch, "nn") else None
