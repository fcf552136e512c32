"""The cluster of this machine."""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator

import ray

__all__ = ["connect"]

#: The smallest object store that Ray starts, in bytes: cells exchange files, not objects.
_STORE = 78 << 20


def connect() -> None:
    """Joins the cluster that `RAY_ADDRESS` or this machine names, or starts one, unless this process has joined one."""
    if ray.is_initialized():
        return
    with _away_from_here():
        try:
            ray.init(address="auto", logging_level=logging.WARNING)
        except ConnectionError:
            ray.init(address="local", object_store_memory=_STORE, include_dashboard=False, logging_level=logging.WARNING)


@contextlib.contextmanager
def _away_from_here() -> Iterator[None]:
    """Makes the folder of the standard library the current one.

    Ray's workers search the folder in which `ray.init` was called for modules, before all others.
    """
    here = os.getcwd()
    os.chdir(os.path.dirname(os.__file__))
    try:
        yield
    finally:
        os.chdir(here)
