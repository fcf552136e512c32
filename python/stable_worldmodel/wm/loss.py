"""Losses that keep latents from collapsing.

Shapes: B clips, T steps, D the latent dimension.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["PLDMLoss", "SIGReg", "TemporalStraighteningLoss", "VCReg"]


class SIGReg(nn.Module):
    """How far random projections of the latents are from a standard normal distribution (Balestriero and LeCun, 2025).

    The statistic of Epps and Pulley: the squared distance between the empirical characteristic function and that of a
    normal distribution, weighted by a Gaussian, integrated over [0, 3] by the trapezoidal rule, times the sample's size.

    Args:
        knots: Points of the integral.
        num_proj: Random directions in each call.
    """

    t: Tensor
    phi: Tensor
    weights: Tensor

    def __init__(self, knots: int = 17, num_proj: int = 1024) -> None:
        super().__init__()
        self.num_proj = num_proj
        points = torch.linspace(0, 3, knots)
        normal = torch.exp(-0.5 * points**2)
        # The integrand is even: both halves count.
        steps = torch.full_like(points, 2 * 3 / (knots - 1))
        steps[0] = steps[-1] = 3 / (knots - 1)
        self.register_buffer("t", points)
        self.register_buffer("phi", normal)
        self.register_buffer("weights", steps * normal)

    def forward(self, proj: Tensor) -> Tensor:
        """The mean statistic of latents `(T, B, D)`, over B for each step and direction."""
        directions = torch.randn(proj.shape[-1], self.num_proj, device=proj.device, dtype=proj.dtype)
        return self.statistic(proj, directions / directions.norm(dim=0))

    def statistic(self, proj: Tensor, directions: Tensor) -> Tensor:
        """The mean statistic for given directions `(D, P)` of length 1."""
        angles = (proj @ directions).unsqueeze(-1) * self.t
        error = (angles.cos().mean(-3) - self.phi) ** 2 + angles.sin().mean(-3) ** 2
        return (error @ self.weights).mean() * proj.shape[-2]


class VCReg(nn.Module):
    """The variance and covariance terms of VICReg (Bardes et al., 2022), over the clips and over the steps.

    Args:
        eps: Added to variances.
    """

    def __init__(self, eps: float = 1e-4) -> None:
        super().__init__()
        self.eps = eps

    def forward(self, z: Tensor) -> dict[str, Tensor]:
        """The terms `std_loss`, `cov_loss` (over B) and `std_t_loss`, `cov_t_loss` (over T) of latents `(B, T, D)`.

        Latents `(B, D)` are those of one step. The terms over T are NaN for one step, and those over B for one clip.
        """
        if z.ndim == 2:
            z = z.unsqueeze(1)
        z = z - z.mean(0, keepdim=True)
        over_time = z.transpose(0, 1)
        return {
            "std_loss": self._spread(z),
            "std_t_loss": self._spread(over_time),
            "cov_loss": self._covariance(z),
            "cov_t_loss": self._covariance(over_time),
        }

    def _spread(self, z: Tensor) -> Tensor:
        """How far the standard deviations over the first axis are below 1, on average."""
        return torch.relu(1 - (z.var(0) + self.eps).sqrt()).mean()

    @staticmethod
    def _covariance(z: Tensor) -> Tensor:
        """The mean squared covariance over the first axis of two different dimensions."""
        count, _, dim = z.shape
        columns = z.transpose(0, 1)
        covariance = columns.transpose(1, 2) @ columns / (count - 1)
        squares = covariance.square().sum((1, 2)) - covariance.diagonal(dim1=1, dim2=2).square().sum(1)
        return (squares / (dim * (dim - 1))).mean()


class PLDMLoss(nn.Module):
    """The terms of PLDM that keep latents from collapsing: VCReg, slowness, and inverse dynamics."""

    def __init__(self) -> None:
        super().__init__()
        self.vc_reg = VCReg()

    def forward(self, z: Tensor, a_pred: Tensor | None = None, a_target: Tensor | None = None) -> dict[str, Tensor]:
        """The terms of latents `(B, T, D)`.

        Args:
            z: The latents.
            a_pred: The actions `(B, T - 1, A)` that inverse dynamics predicts from successive latents.
            a_target: The actions themselves.

        Returns:
            `temp_align_loss` (the mean squared change of a step), the terms of `VCReg`, and with actions `idm_loss`.
        """
        terms = {"temp_align_loss": (z[:, 1:] - z[:, :-1]).square().mean(), **self.vc_reg(z)}
        if a_pred is not None and a_target is not None:
            terms["idm_loss"] = (a_pred - a_target).square().mean()
        return terms


class TemporalStraighteningLoss(nn.Module):
    """Makes trajectories of latents straight: the negative cosine between successive changes (arXiv 2603.12231)."""

    def __init__(self) -> None:
        super().__init__()

    def forward(self, x: Tensor) -> Tensor:
        """The mean of latents `(B, T, D)`, from -1 (straight) to 1."""
        change = x.diff(dim=1)
        return -nn.functional.cosine_similarity(change[:, :-1], change[:, 1:], dim=-1).mean()
