"""TD-MPC2."""

from .module import (
    NormedLinear,
    RunningScale,
    SimNorm,
    gaussian_logprob,
    log_std,
    squash,
    two_hot,
    two_hot_inv,
)
from .tdmpc2 import TDMPC2, tdmpc2_forward

__all__ = [
    "TDMPC2",
    "NormedLinear",
    "RunningScale",
    "SimNorm",
    "gaussian_logprob",
    "log_std",
    "squash",
    "tdmpc2_forward",
    "two_hot",
    "two_hot_inv",
]
