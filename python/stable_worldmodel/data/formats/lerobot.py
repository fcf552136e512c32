"""The format `lerobot`."""

from ..format import FORMATS
from .named import LeRobotAdapter

__all__ = ["LeRobot", "LeRobotAdapter"]

LeRobot = FORMATS["lerobot"]
