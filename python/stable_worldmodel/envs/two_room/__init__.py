"""Two-Room."""

from .env import TwoRoomEnv
from .expert_policy import ExpertPolicy

__all__ = ["ExpertPolicy", "TwoRoomEnv"]
