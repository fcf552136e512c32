"""OGBench."""

from .cube_env import CubeEnv
from .expert_policy import ExpertPolicy
from .maze_env import MazeEnv
from .scene_env import SceneEnv

__all__ = ["CubeEnv", "ExpertPolicy", "MazeEnv", "SceneEnv"]
