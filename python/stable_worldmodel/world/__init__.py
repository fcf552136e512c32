"""`World`, the batch of environments that a policy acts in, and `EnvPool`, a batch of Gymnasium environments."""

from .env_pool import EnvPool
from .metrics import Metrics
from .world import World

__all__ = ["EnvPool", "Metrics", "World"]
