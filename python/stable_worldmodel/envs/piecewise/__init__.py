"""Piecewise."""

from .expert_policy import ExpertPolicy
from .piecewise_env import PiecewiseEnv

__all__ = ["ExpertPolicy", "PiecewiseEnv"]
