"""The Fetch robot."""

from .fetch import FetchWrapper

__all__ = ["FetchWrapper"]
