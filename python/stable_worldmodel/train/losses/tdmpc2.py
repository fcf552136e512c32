"""The losses of TD-MPC2 (Hansen et al., 2024, equations 3 to 6), on clips of a dataset.

The losses of the world model (latents, rewards, values) train all networks but the policy; the loss of the policy trains
the policy only.

Shapes: N clips of this rank, H steps with an action, A the action dimension, D the latent dimension, Q functions, bins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from ...wm.tdmpc2 import TDMPC2, gaussian_logprob, log_std, squash, two_hot, two_hot_inv
from .base import Losses, evaluating

__all__ = ["TDMPC2Losses"]


class TDMPC2Losses(Losses):
    """Consistency of latents, rewards, values by temporal differences, and a policy that maximises value and entropy."""

    model: TDMPC2

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        self._encode, self._next = compiled(self.model.encode), compiled(self.model)
        ends = [] if self.model.termination is None else ["termination"]
        self.names = ("loss", "consistency", "reward", "value", "policy", "q", "entropy", "scale", *ends)
        #: The spread of values after each batch since the last step of the optimizer.
        self._scales: list[Tensor] = []

    def __call__(self, batch: Mapping[str, Tensor], sizes: Sequence[int]) -> dict[str, Tensor]:
        device = batch["action"].device
        if not len(batch["action"]):
            # The other ranks gather their values.
            self._spread(None, sizes, device)
            return {}
        with self.precision():
            terms, inputs = self._world_model(batch)
            policy = self._policy_terms(inputs)
        scale = self._spread(policy["returned"][0].detach(), sizes, device)
        gain = policy["returned"] / scale + self.settings["entropy"] * policy["entropy"]
        loss = -self._weighted(gain)
        total: Any = sum(self.settings[name] * term for name, term in terms.items()) + loss
        logged = {"q": policy["returned"].mean(), "entropy": policy["entropy"].mean() / batch["action"].shape[-1]}
        return {"loss": total, **terms, "policy": loss, **logged, "scale": scale}

    def _weighted(self, values: Tensor) -> Tensor:
        """The mean over clips and steps of values `(H, N)`, of which those of later steps weigh less."""
        steps = torch.arange(len(values), device=values.device)
        return (values.mean(1) * self.settings["rho"] ** steps).mean()  # type: ignore[no-any-return]

    def _world_model(self, batch: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        """The losses of all networks but the policy, and the latents `(H, N, D)` before each action, without gradients."""
        model = self.model
        columns = {name: value if name == "pixels" else value.flatten(2) for name, value in self._observed(batch).items()}
        actions = self.actions(batch)[:, :-1].transpose(0, 1)
        rewards, terminated = (batch[name][:, :-1].flatten(1).float().t() for name in ("reward", "terminated"))
        with torch.no_grad():
            following = self._encode({name: value[:, 1:] for name, value in columns.items()}).transpose(0, 1)
            target = rewards + self.settings["discount"] * (1 - terminated) * self._future(following)
        latents = [self._encode({name: value[:, 0] for name, value in columns.items()})]
        reward_logits = []
        for action in actions:
            later, logits = self._next(latents[-1], action)
            latents.append(later)
            reward_logits.append(logits)
        before, predicted = torch.stack(latents[:-1]), torch.stack(latents[1:])
        both = torch.cat([before, actions], -1)
        regressions = torch.stack([self._regression(q(both), target) for q in model.qs])
        terms = {
            "consistency": self._weighted((predicted.float() - following.float()).square().mean(-1)),
            "reward": self._weighted(self._regression(torch.stack(reward_logits), rewards)),
            "value": self._weighted(regressions.mean(0)),
        }
        if model.termination is not None:
            logits = model.termination(predicted).squeeze(-1).float()
            entropies = nn.functional.binary_cross_entropy_with_logits(logits, terminated, reduction="none")
            terms["termination"] = self._weighted(entropies)
        return terms, before.detach()

    def _observed(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The observations `(N, H + 1, ..)`."""
        return {name: batch[name] if batch[name].ndim > 2 else batch[name].unsqueeze(2) for name in self.model.encoding}

    def _regression(self, logits: Tensor, target: Tensor) -> Tensor:
        """The cross-entropy `(H, N)` of logits `(H, N, bins)` and of the bins of numbers `(H, N)`."""
        weights = two_hot(target.reshape(-1), self.model.cfg).view_as(logits)
        return -(weights * logits.float().log_softmax(-1)).sum(-1)

    def _pair(self) -> list[int]:
        """Two Q functions, chosen at random."""
        return torch.randperm(len(self.model.qs))[:2].tolist()

    def _future(self, latents: Tensor) -> Tensor:
        """The value `(H, N)` of the policy's actions at latents `(H, N, D)`: the lower one of two target Q functions."""
        model = self.model
        both = torch.cat([latents, model._drawn(latents)], -1)
        with evaluating(model.target_qs):
            pairs = [[model.target_qs[index](rows) for index in self._pair()] for rows in both]
        logits = torch.stack([torch.stack(pair) for pair in pairs], 1)
        return two_hot_inv(logits.float(), model.cfg).squeeze(-1).amin(0)

    def _policy_terms(self, latents: Tensor) -> dict[str, Tensor]:
        """The mean value `returned` of two Q functions, and the `entropy`, `(H, N)` each, of the policy's actions.

        The Q functions get no gradient.
        """
        model = self.model
        mean, spread = (part.float() for part in model.pi(latents).chunk(2, -1))
        spread = log_std(spread)
        noise = torch.randn_like(mean)
        _, action, probability = squash(mean, mean + noise * spread.exp(), gaussian_logprob(noise, spread))
        both = torch.cat([latents, action], -1)
        qs: Any = model.qs
        with evaluating(qs):
            pairs = [torch.stack([_frozen(qs[index], rows) for index in self._pair()]) for rows in both]
        returned = two_hot_inv(torch.stack(pairs, 1).float(), model.cfg).squeeze(-1).mean(0)
        return {"returned": returned, "entropy": -probability.squeeze(-1) * action.shape[-1]}

    def _spread(self, returned: Tensor | None, sizes: Sequence[int], device: torch.device) -> Tensor:
        """The running spread of values, moved by the values `(N,)` of the first steps of all ranks' clips."""
        rows = None if returned is None else returned.unsqueeze(1)
        values = self.ranks.gather(rows, sizes, device, differentiable=False)
        running = self.model.scale.value.detach().clone()
        low, high = torch.quantile(values.flatten(), torch.tensor([0.05, 0.95], device=device))
        running.lerp_((high - low).clamp(min=1e-4).reshape(1), float(self.settings["tau"]))
        if self.model.training:
            self._scales.append(running)
        return running.squeeze(0)

    def after_step(self) -> None:
        """Replaces the running spread by the mean of those of the step's batches, and moves the target Q functions."""
        model, scales = self.model, self._scales
        with torch.no_grad():
            model.scale.value.copy_(torch.stack(scales).mean(0))
            for parameter, target in zip(model.qs.parameters(), model.target_qs.parameters(), strict=True):
                target.lerp_(parameter, float(self.settings["tau"]))
        scales.clear()


def _frozen(network: nn.Module, x: Tensor) -> Tensor:
    """The output of a network whose parameters get no gradient."""
    parameters = {name: parameter.detach() for name, parameter in network.named_parameters()}
    return torch.func.functional_call(network, parameters, (x,))  # type: ignore[no-any-return]
