"""The cluster of this machine."""

from __future__ import annotations

import logging

import ray

__all__ = ["connect"]

#: The smallest object store that Ray starts, in bytes: cells exchange files, not objects.
_STORE = 78 << 20


def connect() -> None:
    """Joins the cluster that `RAY_ADDRESS` or this machine names, or starts one, unless this process has joined one."""
    if ray.is_initialized():
        return
    try:
        ray.init(address="auto", logging_level=logging.WARNING)
    except ConnectionError:
        ray.init(address="local", object_store_memory=_STORE, include_dashboard=False, logging_level=logging.WARNING)
