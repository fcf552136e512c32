"""PLDM."""

from .pldm import PLDM

__all__ = ["PLDM"]
