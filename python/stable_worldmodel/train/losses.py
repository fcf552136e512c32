"""The losses of a training step, as the engine computes them.

Shapes: B clips of a batch on all ranks, N those of this rank, T steps, D the latent dimension, A the dimension of a model
step, P patches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from ..wm.gcrl import GCRL, ExpectileLoss
from ..wm.jepa import JEPA
from ..wm.loss import PLDMLoss, SIGReg, TemporalStraighteningLoss
from ..wm.pretrained import Stored
from .ranks import Ranks

__all__ = ["Losses", "losses_of"]

#: The largest weight of an action, as published.
LARGEST_WEIGHT = 100.0
#: The weight of a batch in running statistics.
_MOMENTUM = 0.1


class Losses:
    """The losses of a family.

    Args:
        model: The module, of a checkpoint of the engine.
        ranks: The processes of the training.
        precision: Creates the context in which networks compute, such as that of `torch.autocast`.
        compiled: Compiles the forward pass of a network.
    """

    #: The names of the losses, the one to minimise first.
    names: tuple[str, ...] = ("loss",)
    #: Whether every rank computes the losses of the whole batch; otherwise those of its slice.
    whole_batch: ClassVar[bool] = False

    def __init__(
        self,
        model: Any,
        ranks: Ranks,
        precision: Callable[[], AbstractContextManager[Any]],
        compiled: Callable[[Any], Any] = lambda network: network,
    ) -> None:
        self.model, self.ranks, self.precision = model, ranks, precision
        stored: Stored = model.stored
        self.settings: Mapping[str, Any] = stored.config["loss"]
        scale = stored.file["facts"]["action"]
        block = model.action_block
        self.mean, self.std = (torch.tensor(scale[name] * block, dtype=torch.float32) for name in ("mean", "std"))
        self.compile(compiled)

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        """Compiles the networks of the losses."""

    def __call__(self, batch: Mapping[str, Tensor], sizes: Sequence[int]) -> dict[str, Tensor]:
        """The losses of a batch from the loader; empty if this rank has no clips and computes only its slice.

        Args:
            batch: The slice of this rank: `pixels` `(N, T, 3, H, W)` and `action` `(N, T, A)` in the environment's units.
            sizes: The clips of each rank.
        """
        raise NotImplementedError

    def actions(self, batch: Mapping[str, Tensor]) -> Tensor:
        """The actions `(N, T, A)` in the model's units; missing ones (NaN) are 0."""
        action = batch["action"]
        return ((action - self.mean.to(action.device)) / self.std.to(action.device)).nan_to_num()

    def after_step(self) -> None:
        """Updates target networks after a step of the optimizer."""

    def accumulate(self, index: int, count: int) -> None:
        """Prepares for batch `index` of the `count` batches of a step, which move running statistics as their mean does."""
        for norm in _norms(self.model):
            norm.momentum = 1 - (1 - _MOMENTUM * (index + 1) / count) / (1 - _MOMENTUM * index / count)

    @contextmanager
    def validating(self) -> Iterator[None]:
        """Without dropout. Whole batches are normalised by their own statistics, as in training."""
        self.model.eval()
        with _unchanged_statistics(self.model) as norms:
            for norm in norms:
                norm.train(self.whole_batch)
            yield

    def share(self, sizes: Sequence[int]) -> float:
        """The factor of this rank's loss in the sum over the ranks."""
        return 1 / self.ranks.size if self.whole_batch else sizes[self.ranks.rank] / sum(sizes)


class Joint(Losses):
    """Base class of LeWM and PLDM: the squared error of predicted latents and a regulariser of all latents.

    Every rank encodes its slice. The features of all ranks are gathered, because normalisations and regularisers depend on
    the whole batch.
    """

    whole_batch = True
    model: JEPA

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        self._encode, self._predict = compiled(self.model._features), compiled(self.model.predictor)

    def __call__(self, batch: Mapping[str, Tensor], sizes: Sequence[int]) -> dict[str, Tensor]:
        model, pixels = self.model, batch["pixels"]
        count, steps, device = len(pixels), pixels.shape[1], pixels.device
        with self.precision():
            features = self._encode(model.frames(pixels).flatten(0, 1)) if count else None
        gathered = self.ranks.gather(features, [size * steps for size in sizes], device)
        actions = self.ranks.gather(self.actions(batch) if count else None, sizes, device, differentiable=False)
        history = self._history(steps)
        with self.precision():
            z = model.projector(gathered).unflatten(0, (-1, steps))
            predicted = self._predict(_windows(z, history, 0), model.action_encoder(_windows(actions, history, 0)))
            predicted = model.pred_proj(predicted.flatten(0, 1)).unflatten(0, (-1, history))
        z = z.float()
        prediction = (predicted.float() - _windows(z, history, 1)).square().mean()
        regulariser, terms = self.regularise(z, actions)
        return {"loss": prediction + regulariser, "prediction": prediction, **terms}

    def _history(self, steps: int) -> int:
        return min(int(self.model.predictor.num_frames), steps - 1)  # type: ignore[arg-type]

    def regularise(self, z: Tensor, actions: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The regulariser of the latents `(B, T, D)`, and its terms."""
        raise NotImplementedError


def _windows(x: Tensor, history: int, offset: int) -> Tensor:
    """The runs of `history` steps that another step follows, moved by `offset` steps: `(runs * B, history, ..)`."""
    return torch.cat([x[:, begin + offset : begin + offset + history] for begin in range(x.shape[1] - history)])


class LeWMLosses(Joint):
    """LeWM: SIGReg (Maes et al., 2026), and optionally straight paths of latents."""

    names: tuple[str, ...] = ("loss", "prediction", "sigreg")

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        super().compile(compiled)
        #: The weight of straight paths.
        self.straight = float(self.settings.get("temp_straight", 0.0))
        if self.straight:
            self.names = (*self.names, "temp_straight")
        self.sigreg = SIGReg(self.settings["knots"], self.settings["directions"])

    def regularise(self, z: Tensor, actions: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        sigreg = self.sigreg.to(z.device)(z.transpose(0, 1))
        total, terms = self.settings["weight"] * sigreg, {"sigreg": sigreg}
        if self.straight:
            terms["temp_straight"] = TemporalStraighteningLoss()(z)
            total = total + self.straight * terms["temp_straight"]
        return total, terms


class PLDMLosses(Joint):
    """PLDM: variance, covariance, temporal alignment, and inverse dynamics (Sobal et al., 2025)."""

    names = ("loss", "prediction", "std", "std_t", "cov", "cov_t", "temp_align", "idm", "temp_straight")

    def regularise(self, z: Tensor, actions: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        idm: Any = self.model.idm
        found = PLDMLoss()(z, idm(z), actions[:, :-1])
        terms = {name.removesuffix("_loss"): term for name, term in found.items()}
        terms["temp_straight"] = TemporalStraighteningLoss()(z) if z.shape[1] > 2 else z.new_zeros(())
        total: Any = sum(self.settings[name] * term for name, term in terms.items() if self.settings[name])
        return total, terms


class GoalConditioned(Losses):
    """Base class of GCBC, GCIVL and GCIQL."""

    model: GCRL

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        encoder: Any = self.model.encoder
        self._patches = compiled(encoder.patches)
        self._policy = compiled(self.model.action_predictor)

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
        with torch.no_grad(), _unchanged_statistics(self.model.encoder):
            later, policy_goal = (
                self._patches(self.model.frames(images.flatten(0, 1)))
                for images in (batch["pixels"][:, self.history :], batch["policy_goal_pixels"])
            )
        seen, aim = now.detach(), goal.detach()
        following = torch.cat([seen[:, seen.shape[1] // self.history :], later], 1)
        actions = self.actions(batch)[:, : self.history]
        frames = batch["pixels"][:, : self.history]
        reached = (frames == batch["goal_pixels"]).flatten(2).all(2, keepdim=True).float()
        with torch.no_grad(), _evaluating(value):
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
        with _evaluating(critic):
            advantage = critic(seen, actions, policy_goal) - value(seen, policy_goal)
            return advantage, critic.teacher(seen, actions, goal)

    def critic(self, now: Tensor, goal: Tensor, actions: Tensor, target: Tensor) -> dict[str, Tensor]:
        critic: Any = self.model.critic_predictor
        return {"critic_loss": (critic(now, actions, goal) - target).float().square().mean()}


@contextmanager
def _evaluating(network: Any) -> Iterator[None]:
    """Without dropout."""
    training = network.training
    network.eval()
    try:
        yield
    finally:
        network.train(training)


@contextmanager
def _unchanged_statistics(network: nn.Module) -> Iterator[list[Any]]:
    """The batch normalisations, which do not update their running statistics."""
    norms = _norms(network)
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.momentum = 0.0
    try:
        yield norms
    finally:
        for norm, momentum in zip(norms, momenta, strict=True):
            norm.momentum = momentum


def _norms(network: nn.Module) -> list[Any]:
    return [module for module in network.modules() if isinstance(module, (nn.BatchNorm1d, nn.BatchNorm2d))]


_LOSSES: Mapping[str, type[Losses]] = {
    "lewm": LeWMLosses,
    "pldm": PLDMLosses,
    "gcbc": GCBCLosses,
    "gcivl": GCIVLLosses,
    "gciql": GCIQLLosses,
}


def losses_of(family: str) -> type[Losses]:
    """The losses of a family.

    Raises:
        ValueError: If the family is trained by the engine only.
    """
    if family not in _LOSSES:
        known = ", ".join(_LOSSES)
        raise ValueError(f"the family {family!r} is not trained in torch ({known} are); train it with `swm train`")
    return _LOSSES[family]
