"""The losses of GCBC, GCIVL and GCIQL.

Shapes: N clips of this rank, T steps, D the features of a patch, P patches of a frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ...wm.gcrl import GCRL, ExpectileLoss
from .base import Losses, evaluating, unchanged_statistics

__all__ = ["GCBCLosses", "GCIQLLosses", "GCIVLLosses", "GoalConditioned", "ValueLearning"]

#: The largest weight of an action, as published.
LARGEST_WEIGHT = 100.0


class GoalConditioned(Losses):
    """Base class of GCBC, GCIVL and GCIQL."""

    not_called = ("encode", "predict_actions", "predict_values")
    model: GCRL

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        encoder: Any = self.model.encoder
        self._patches = compiled(encoder.patches)
        self._policy = compiled(self.model.action_predictor)

    def train_mode(self) -> None:
        super().train_mode()
        if self.frozen:
            self.model.encoder.eval()

    @property
    def history(self) -> int:
        """Frames that the policy gets."""
        return self.model.history_size

    def __call__(self, batch: Mapping[str, Tensor], sizes: Sequence[int]) -> dict[str, Tensor]:
        if not len(batch["pixels"]):
            return {}
        with self.precision():
            return self.losses(batch)

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The losses of the slice of this rank, which has clips."""
        raise NotImplementedError

    def observed(self, batch: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The patches of the history `(N, T * P, D)` and of the goal `(N, P, D)`, encoded as one batch."""
        frames = batch["pixels"][:, : self.history]
        images = torch.cat([frames.flatten(0, 1), batch["goal_pixels"].flatten(0, 1)])
        with torch.set_grad_enabled(torch.is_grad_enabled() and not self.frozen):
            patches = self._patches(self.model.frames(images))
        history, goal = patches.split([len(images) - len(frames), len(frames)])
        return history.unflatten(0, frames.shape[:2]).flatten(1, 2), goal

    @property
    def frozen(self) -> bool:
        """Whether the encoder is not trained."""
        return bool(self.model.stored.config["model"]["frozen"])  # type: ignore[union-attr]


class GCBCLosses(GoalConditioned):
    """GCBC: the squared error of actions."""

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        now, goal = self.observed(batch)
        error = self._policy(now, goal) - self.actions(batch)[:, : self.history]
        return {"loss": error.float().square().mean()}


class ValueLearning(GoalConditioned):
    """Base class of GCIVL and GCIQL: values by expectile regression, a policy by advantage-weighted regression."""

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        super().compile(compiled)
        self.expectile = ExpectileLoss(self.settings["expectile"])

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        settings = self.settings
        value: Any = self.model.value_predictor
        now, goal = self.observed(batch)
        with torch.no_grad(), unchanged_statistics(self.model.encoder):
            later, policy_goal = (
                self._patches(self.model.frames(images.flatten(0, 1)))
                for images in (batch["pixels"][:, self.history :], batch["policy_goal_pixels"])
            )
        seen, aim = now.detach(), goal.detach()
        following = torch.cat([seen[:, seen.shape[1] // self.history :], later], 1)
        actions = self.actions(batch)[:, : self.history]
        frames = batch["pixels"][:, : self.history]
        reached = (frames == batch["goal_pixels"]).flatten(2).all(2, keepdim=True).float()
        with torch.no_grad(), evaluating(value):
            target = (value.teacher(following, aim) * settings["discount"] - 1) * (1 - reached)
            advantage, value_target = self.evaluated(seen, following, policy_goal, aim, actions, target)
        values = value(now, goal)
        terms = {"value_loss": self.expectile(values.float(), value_target.float()), **self.critic(now, goal, actions, target)}
        weight = (advantage.float() * settings["temperature"]).clamp(max=math.log(LARGEST_WEIGHT)).exp()
        terms["policy_loss"] = self._regression(self._policy(seen, policy_goal).float(), actions, weight)
        total: Any = sum(terms.values())
        logged = {"value": values.mean(), "weight": weight.mean(), "reached": reached.mean()}
        return {"loss": total, **terms, **logged}

    def evaluated(
        self, seen: Tensor, following: Tensor, policy_goal: Tensor, goal: Tensor, actions: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The advantage of the actions for the policy's goal, and the target of the values, `(N, T, 1)` each."""
        raise NotImplementedError

    def critic(self, now: Tensor, goal: Tensor, actions: Tensor, target: Tensor) -> dict[str, Tensor]:
        """The loss of the critic, if there is one."""
        return {}

    def _regression(self, means: Tensor, actions: Tensor, weight: Tensor) -> Tensor:
        """The weighted negative log-likelihood of the actions, without the constant."""
        model = self.model
        log_stds = model.log_stds.clamp(model.log_std_min, model.log_std_max)
        likelihood = (actions - means).square() * (-2 * log_stds).exp() / 2 + log_stds
        return (likelihood * weight).mean()

    def after_step(self) -> None:
        for network in (self.model.value_predictor, self.model.critic_predictor):
            if network is not None:
                network.update_target(self.settings["target"])  # type: ignore[operator]


class GCIVLLosses(ValueLearning):
    """GCIVL: the advantage is the change of the value."""

    names = ("loss", "value_loss", "policy_loss", "value", "weight", "reached")

    def evaluated(
        self, seen: Tensor, following: Tensor, policy_goal: Tensor, goal: Tensor, actions: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        value: Any = self.model.value_predictor
        return value(following, policy_goal) - value(seen, policy_goal), target


class GCIQLLosses(ValueLearning):
    """GCIQL: the advantage is the critic's value of an action less the value."""

    names = ("loss", "value_loss", "critic_loss", "policy_loss", "value", "weight", "reached")

    def evaluated(
        self, seen: Tensor, following: Tensor, policy_goal: Tensor, goal: Tensor, actions: Tensor, target: Tensor
    ) -> tuple[Tensor, Tensor]:
        value: Any = self.model.value_predictor
        critic: Any = self.model.critic_predictor
        with evaluating(critic):
            advantage = critic(seen, actions, policy_goal) - value(seen, policy_goal)
            return advantage, critic.teacher(seen, actions, goal)

    def critic(self, now: Tensor, goal: Tensor, actions: Tensor, target: Tensor) -> dict[str, Tensor]:
        critic: Any = self.model.critic_predictor
        return {"critic_loss": (critic(now, actions, goal) - target).float().square().mean()}
