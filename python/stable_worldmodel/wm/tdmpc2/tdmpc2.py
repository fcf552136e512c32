"""`TDMPC2`: a world model of latents, rewards, values and a policy (Hansen et al., 2024).

Shapes: B environments or clips, S candidates, H steps, A the action dimension, D the latent dimension.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch import Tensor, nn

from ..frames import Frames
from ..pretrained import Pretrained
from .module import (
    NormedLinear,
    RunningScale,
    SimNorm,
    gaussian_logprob,
    log_std,
    mlp,
    setting,
    squash,
    two_hot,
    two_hot_inv,
    weight_init,
    zero_init,
)

__all__ = ["TDMPC2", "tdmpc2_forward"]


class TDMPC2(Pretrained):
    """TD-MPC2 for continuous actions from -1 to 1. Solvers minimise `get_cost`, the negative return.

    Args:
        cfg: The configuration: `action_dim`; `extra_dims`, the elements of each column; `image_size` for frames; and `wm`
            with `encoding` (the latent elements of `pixels` and of each column), `enc_dim`, `mlp_dim`, `num_q`, `num_bins`,
            `vmin`, `vmax`, `tau`, and for training `dropout`, `horizon`, `rho`, `discount` and the weights of the losses;
            `termination` says whether the ends of episodes are predicted.
        extra_encoders: The encoders of the columns, instead of two linear layers for each.
    """

    def __init__(self, cfg: Any, extra_encoders: nn.ModuleDict | None = None) -> None:
        super().__init__()
        self.cfg = cfg
        wm = setting(cfg, "wm")
        actions, width, bins = int(setting(cfg, "action_dim")), int(setting(wm, "mlp_dim")), int(setting(wm, "num_bins"))
        #: The latent elements of each observation.
        self.encoding: dict[str, int] = {key: int(size) for key, size in dict(setting(wm, "encoding", {})).items()}
        self.latent_dim = sum(self.encoding.values())
        if not self.latent_dim:
            raise ValueError("TDMPC2: cfg.wm.encoding is empty; name 'pixels' or a column with its latent elements")
        self.use_pixels = "pixels" in self.encoding
        #: How frames of `uint8` become inputs of the encoder: -0.5 to 0.5, as published.
        self.frames = Frames((0.5, 0.5, 0.5), (1.0, 1.0, 1.0))
        self.scale = RunningScale(float(setting(wm, "tau", 0.01)))
        if self.use_pixels:
            self.cnn = _convolutions()
            side = int(setting(cfg, "image_size"))
            # Without memory for the frame.
            with torch.no_grad(), torch.device("meta"):
                features = _convolutions()(torch.zeros(1, 3, side, side)).shape[1]
            self.pixel_encoder = nn.Linear(features, self.encoding["pixels"])
        self.extra_encoders = self._encoders(wm) if extra_encoders is None else extra_encoders
        self.sim_norm = SimNorm(cfg)
        latent, both = self.latent_dim, self.latent_dim + actions
        self.dynamics = mlp(both, width, latent, act=SimNorm(cfg))
        self.reward = mlp(both, width, bins)
        self.pi = mlp(latent, width, 2 * actions)
        dropout = float(setting(wm, "dropout", 0.01))
        self.qs = nn.ModuleList(mlp(both, width, bins, dropout=dropout) for _ in range(int(setting(wm, "num_q"))))
        #: The logit of the end of an episode at a latent; `None` if ends are not predicted.
        self.termination = mlp(latent, width, 1) if setting(wm, "termination", False) else None
        self.apply(weight_init)
        heads: Any = [self.reward, *self.qs]
        zero_init(head[-1].weight for head in heads)
        self.target_qs = copy.deepcopy(self.qs).requires_grad_(False)

    def _encoders(self, wm: Any) -> nn.ModuleDict:
        """Two linear layers for each column."""
        sizes, width = setting(self.cfg, "extra_dims", {}), int(setting(wm, "enc_dim", 256))
        columns = {key: size for key, size in self.encoding.items() if key != "pixels"}
        return nn.ModuleDict(
            {
                key: nn.Sequential(NormedLinear(int(sizes[key]), width), nn.Linear(width, size), nn.LayerNorm(size))
                for key, size in columns.items()
            }
        )

    def encode(self, obs_dict: dict[str, Any]) -> Tensor:
        """The latents `(.., D)` of observations: frames `(.., 3, H, W)` or `(.., H, W, 3)`, and columns `(.., elements)`."""
        dtype = next(self.parameters()).dtype
        parts = []
        if self.use_pixels:
            frames = self.frames(obs_dict["pixels"], dtype)
            frames = frames.movedim(-1, -3) if frames.shape[-1] == 3 else frames
            features = self.pixel_encoder(self.cnn(frames.flatten(0, -4)))
            parts.append(features.unflatten(0, frames.shape[:-3]))
        for key, encoder in self.extra_encoders.items():
            parts.append(encoder(obs_dict[key].to(dtype)))
        return self.sim_norm(torch.cat(parts, -1))  # type: ignore[no-any-return]

    def forward(self, z: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The next latents `(.., D)`, and the logits `(.., num_bins)` of the reward."""
        both = torch.cat([z, action], -1)
        return self.dynamics(both), self.reward(both)

    def _drawn(self, z: Tensor) -> Tensor:
        """Actions `(.., A)` drawn from the policy."""
        mean, spread = self.pi(z).chunk(2, -1)
        return (mean + log_std(spread).exp() * torch.randn_like(mean)).tanh()  # type: ignore[no-any-return]

    def rollout(self, z: Tensor, horizon: int, num_trajs: int = 1) -> Tensor:
        """The actions `(B, horizon, A)` of the policy from latents `(B, D)`, the mean of `num_trajs` drawn sequences."""
        z = z.repeat(num_trajs, 1)
        actions = []
        for _ in range(horizon):
            actions.append(self._drawn(z))
            z = self.dynamics(torch.cat([z, actions[-1]], -1))
        samples: Tensor = torch.stack(actions, 1).unflatten(0, (num_trajs, -1))
        return samples.mean(0)

    def _observed(self, info_dict: dict[str, Any], device: torch.device) -> Tensor:
        return self.encode({key: info_dict[key].to(device) for key in self.encoding})

    def get_action(self, info_dict: dict[str, Any], horizon: int = 1, prefix_actions: Tensor | None = None) -> Tensor:
        """The actions `(B, horizon, A)` of the policy.

        Args:
            info_dict: Observations `(B, ..)`, or `(B, T, ..)`, of which the last step counts.
            horizon: The number of actions.
            prefix_actions: Actions `(B, n, A)` before the first one.
        """
        device = next(self.parameters()).device
        z = self._observed(info_dict, device)
        z = z[:, -1] if z.ndim == 3 else z
        for action in () if prefix_actions is None else prefix_actions.to(device).unbind(1):
            z = self.dynamics(torch.cat([z, action], -1))
        return self.rollout(z, horizon, int(setting(self.cfg, "num_pi_trajs", 1)))

    def get_cost(self, info_dict: dict[str, Any], action_candidates: Tensor) -> Tensor:
        """The negative returns `(B, S)` of candidates `(B, S, H, A)`.

        The return adds up the discounted rewards until the predicted end of the episode, and the value after the last step:
        the mean of the Q functions, less their disagreement times `uncertainty_penalty`.

        Args:
            info_dict: Observations `(B, S, ..)`, or `(B, S, T, ..)`, of which the last step counts; or `(B, ..)`.
            action_candidates: The candidates.
        """
        wm = setting(self.cfg, "wm")
        envs, samples, horizon, _ = action_candidates.shape
        if "_latent" not in info_dict:
            z = self._observed(info_dict, action_candidates.device)
            z = z[:, :, -1] if z.ndim == 4 else z
            info_dict["_latent"] = z.unsqueeze(1).expand(-1, samples, -1) if z.ndim == 2 else z
        z = info_dict["_latent"].reshape(envs * samples, -1)
        discount, gamma = 1.0, float(setting(wm, "discount", 0.99))
        total, alive = z.new_zeros(len(z), 1), z.new_ones(len(z), 1)
        for step in range(horizon):
            z, reward = self(z, action_candidates[:, :, step].flatten(0, 1))
            total = total + alive * discount * two_hot_inv(reward, self.cfg)
            if self.termination is not None:
                alive = alive * (self.termination(z) < 0)
            discount *= gamma
        both = torch.cat([z, self.pi(z).chunk(2, -1)[0].tanh()], -1)
        values = torch.stack([two_hot_inv(q(both), self.cfg) for q in self.qs])
        mean = values.mean(0)
        penalty = float(setting(wm, "uncertainty_penalty", 0.5)) * mean.abs() * values.std(0)
        value: Tensor = total + alive * discount * (mean - penalty)
        return -value.view(envs, samples)


def _convolutions() -> nn.Sequential:
    """The encoder of frames with a side of 64 pixels."""
    layers: list[nn.Module] = []
    inputs = 3
    for kernel, stride in ((7, 2), (5, 2), (3, 2), (3, 1)):
        layers += [nn.Conv2d(inputs, 32, kernel, stride=stride), nn.Mish()]
        inputs = 32
    return nn.Sequential(*layers, nn.Flatten())


def tdmpc2_forward(self: Any, batch: dict[str, Any], stage: str, cfg: Any) -> dict[str, Any]:
    """The loss of a batch of clips, as a training step: `self` has `model`, and `log_dict` for the logs.

    Args:
        self: The training module.
        batch: Observations and `action` `(B, T + 1, ..)`, and `reward` `(B, T + 1)` or `(B, T + 1, 1)`.
        stage: `"train"` also moves the target Q functions.
        cfg: The configuration; see `TDMPC2`.

    Returns:
        The batch with `loss`.
    """
    model, wm = self.model, setting(cfg, "wm")
    horizon, rho, gamma = int(setting(wm, "horizon")), float(setting(wm, "rho")), float(setting(wm, "discount", 0.99))
    latents = model.encode({key: batch[key] for key in model.encoding})
    actions, rewards = (batch[name].to(latents.dtype) for name in ("action", "reward"))
    rewards = rewards.reshape(*rewards.shape[:2], 1)
    z = latents[:, 0]
    losses = dict.fromkeys(("consist", "reward", "value", "policy"), z.new_zeros(()))

    def regression(logits: Tensor, target: Tensor) -> Tensor:
        return -(two_hot(target, cfg) * logits.log_softmax(-1)).sum(-1).mean()

    def value(qs: Any, both: Tensor) -> Tensor:
        """The values `(2, B, 1)` of two Q functions chosen at random."""
        chosen = torch.randperm(len(qs))[:2].tolist()
        return torch.stack([two_hot_inv(qs[index](both), cfg) for index in chosen])

    for step in range(horizon):
        weight, action, reward, later = rho**step, actions[:, step], rewards[:, step], latents[:, step + 1].detach()
        following, logits = model(z, action)
        losses["consist"] = losses["consist"] + weight * (following - later).square().mean()
        losses["reward"] = losses["reward"] + weight * regression(logits, reward)
        with torch.no_grad():
            both = torch.cat([later, model._drawn(later)], -1)
            target = reward + gamma * value(model.target_qs, both).amin(0)
        both = torch.cat([z, action], -1)
        for q in model.qs:
            losses["value"] = losses["value"] + weight * regression(q(both), target)
        losses["policy"] = losses["policy"] + weight * _policy_loss(model, z.detach(), value, step == 0, cfg)
        z = following
    losses = {name: loss / horizon for name, loss in losses.items()}
    losses["value"] = losses["value"] / len(model.qs)
    weights = {"consist": "consistency_coef", "reward": "reward_coef", "value": "value_coef"}
    total = losses["policy"] + sum(float(setting(wm, key)) * losses[name] for name, key in weights.items())
    logs = {f"{stage}/{name}": loss for name, loss in {"loss": total, **losses}.items()}
    self.log_dict(logs, on_step=True, sync_dist=False, prog_bar=True)
    if stage == "train":
        with torch.no_grad():
            pairs = zip(model.qs.parameters(), model.target_qs.parameters(), strict=True)
            for parameter, target in pairs:
                target.lerp_(parameter, float(setting(wm, "tau", 0.01)))
    batch["loss"] = total
    return batch


def _policy_loss(model: TDMPC2, z: Tensor, value: Any, first: bool, cfg: Any) -> Tensor:
    """The negative value and entropy of the policy at latents `(B, D)`; the Q functions get no gradient."""
    mean, spread = model.pi(z).chunk(2, -1)
    spread = log_std(spread)
    noise = torch.randn_like(mean)
    _, action, probability = squash(mean, mean + noise * spread.exp(), gaussian_logprob(noise, spread))
    model.qs.requires_grad_(False)
    try:
        returned = value(model.qs, torch.cat([z, action], -1)).mean(0)
    finally:
        model.qs.requires_grad_(True)
    if first:
        model.scale.update(returned)
    entropy = -probability * int(setting(cfg, "action_dim"))
    return -(model.scale(returned) + float(setting(setting(cfg, "wm"), "entropy_coef", 1e-4)) * entropy).mean()  # type: ignore[no-any-return]
