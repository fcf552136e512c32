"""The DeepMind Control suite: a module for each domain."""

from .expert_policy import ExpertPolicy

__all__ = ["ExpertPolicy"]
