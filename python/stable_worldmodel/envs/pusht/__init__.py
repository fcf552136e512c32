"""Push-T."""

from .env import PushT
from .env_discrete import PushTDiscrete
from .expert_policy import WeakPolicy

__all__ = ["PushT", "PushTDiscrete", "WeakPolicy"]
