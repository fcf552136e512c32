"""The parts of TD-MPC2 (Hansen et al., 2024): layers, discrete regression, and the policy's distribution.

`cfg.wm` has `num_bins`, `vmin` and `vmax` of the discrete regression and `simnorm_dim`; a mapping with attributes, such as a
configuration of OmegaConf, or a plain dict.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

__all__ = [
    "NormedLinear",
    "RunningScale",
    "SimNorm",
    "gaussian_logprob",
    "log_std",
    "mlp",
    "setting",
    "squash",
    "symexp",
    "symlog",
    "two_hot",
    "two_hot_inv",
    "weight_init",
    "zero_init",
]


def setting(cfg: Any, name: str, default: Any = None) -> Any:
    """The setting of a configuration with this name: an entry of a mapping, or an attribute."""
    if hasattr(cfg, "get"):
        found = cfg.get(name)
    else:
        found = getattr(cfg, name, None)
    return default if found is None else found


def symlog(x: Tensor) -> Tensor:
    """The logarithm of `1 + |x|` with the sign of `x`."""
    return x.sign() * x.abs().log1p()


def symexp(x: Tensor) -> Tensor:
    """The inverse of `symlog`."""
    return x.sign() * x.abs().expm1()


def _bins(cfg: Any) -> tuple[int, float, float]:
    wm = setting(cfg, "wm")
    return int(setting(wm, "num_bins")), float(setting(wm, "vmin")), float(setting(wm, "vmax"))


def two_hot(x: Tensor, cfg: Any) -> Tensor:
    """The numbers `(N,)` or `(N, 1)` as weights `(N, num_bins)` of the two bins around their `symlog`."""
    count, low, high = _bins(cfg)
    position = (symlog(x.reshape(-1)).clamp(low, high) - low) * ((count - 1) / (high - low))
    below = position.floor().clamp(0, count - 2)
    above = (position - below).unsqueeze(1)
    # The weights of NaN are NaN, so that the loss says so.
    index = below.nan_to_num(0).long().unsqueeze(1)
    weights = position.new_zeros(len(position), count)
    return weights.scatter(1, index, 1 - above).scatter(1, index + 1, above)


def two_hot_inv(logits: Tensor, cfg: Any) -> Tensor:
    """The numbers `(.., 1)` that logits `(.., num_bins)` stand for."""
    count, low, high = _bins(cfg)
    bins = torch.linspace(low, high, count, device=logits.device, dtype=logits.dtype)
    return symexp((logits.softmax(-1) * bins).sum(-1, keepdim=True))


def log_std(x: Tensor, low: float = -10, dif: float = 12) -> Tensor:
    """The logarithm of a standard deviation, from `low` to `low + dif`."""
    return low + dif * (x.tanh() + 1) / 2


def gaussian_logprob(eps: Tensor, log_std: Tensor) -> Tensor:
    """The log-probability `(.., 1)` of a diagonal Gaussian at `mean + exp(log_std) * eps`."""
    return (-eps.square() / 2 - log_std - math.log(2 * math.pi) / 2).sum(-1, keepdim=True)


def squash(mu: Tensor, pi: Tensor, log_pi: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and action mapped to -1 ..= 1 by the hyperbolic tangent, and the action's log-probability there."""
    action = pi.tanh()
    stretch = ((1 - action.square()).relu() + 1e-6).log().sum(-1, keepdim=True)
    return mu.tanh(), action, log_pi - stretch


class SimNorm(nn.Module):
    """Softmax over groups of `simnorm_dim` (8 by default) elements."""

    def __init__(self, cfg: Any) -> None:
        super().__init__()
        self.simplex_dim = int(setting(setting(cfg, "wm"), "simnorm_dim", 8))

    def forward(self, x: Tensor) -> Tensor:
        """`(.., dim)` to `(.., dim)`."""
        groups: Tensor = x.unflatten(-1, (-1, self.simplex_dim))
        return groups.softmax(-1).flatten(-2)


class NormedLinear(nn.Linear):
    """A linear layer, dropout, layer normalisation, and an activation (Mish by default)."""

    def __init__(
        self,
        in_features: int,
        out_features: int,
        bias: bool = True,
        dropout: float = 0.0,
        act: nn.Module | None = None,
    ) -> None:
        super().__init__(in_features, out_features, bias=bias)
        self.ln = nn.LayerNorm(out_features)
        self.act = nn.Mish() if act is None else act
        self.dropout = nn.Dropout(dropout) if dropout else None

    def forward(self, x: Tensor) -> Tensor:
        """`(.., in_features)` to `(.., out_features)`."""
        x = super().forward(x)
        x = x if self.dropout is None else self.dropout(x)
        return self.act(self.ln(x))  # type: ignore[no-any-return]


class RunningScale(nn.Module):
    """Divides values by the running range between their 5th and 95th percentile.

    Args:
        tau: The weight of a new range.
    """

    value: Tensor

    def __init__(self, tau: float = 0.01) -> None:
        super().__init__()
        self.tau = tau
        self.register_buffer("value", torch.full((1,), 10.0))

    @torch.no_grad()
    def update(self, x: Tensor) -> None:
        """Moves the range towards that of the values."""
        low, high = torch.quantile(x.detach().float(), torch.tensor([0.05, 0.95], device=x.device))
        self.value.lerp_((high - low).clamp(min=1e-4).reshape(1), self.tau)

    def forward(self, x: Tensor, update: bool = False) -> Tensor:
        """The values divided by the range, which is updated first on demand."""
        if update:
            self.update(x)
        return x / self.value


def mlp(in_dim: int, mlp_dim: int, out_dim: int, act: nn.Module | None = None, dropout: float = 0.0) -> nn.Sequential:
    """Three linear layers. The last one is normalised only if it has an activation; the first one has the dropout."""
    last = nn.Linear(mlp_dim, out_dim) if act is None else NormedLinear(mlp_dim, out_dim, act=act)
    return nn.Sequential(NormedLinear(in_dim, mlp_dim, dropout=dropout), NormedLinear(mlp_dim, mlp_dim), last)


def weight_init(m: nn.Module) -> None:
    """Initialises a linear layer: a truncated normal distribution of weights, no bias."""
    if isinstance(m, nn.Linear):
        nn.init.trunc_normal_(m.weight, std=0.02)
        if m.bias is not None:
            nn.init.zeros_(m.bias)


@torch.no_grad()
def zero_init(params: Iterable[Tensor | None]) -> None:
    """Sets parameters to zero."""
    for parameter in params:
        if parameter is not None:
            parameter.zero_()
