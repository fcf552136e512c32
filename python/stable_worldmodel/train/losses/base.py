"""`Losses`: what the families' losses have in common.

Shapes: B clips of a batch on all ranks, N those of this rank, T steps, A the dimension of a model step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from ..._overrides import is_overridden
from ...wm.pretrained import Pretrained, Stored
from ..ranks import Ranks

__all__ = ["Losses", "evaluating", "unchanged_statistics", "windows"]

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

    #: The names of the losses and of other values of the log, the loss to minimise first.
    names: tuple[str, ...] = ("loss",)
    #: Whether every rank computes the losses of the whole batch; otherwise those of its slice.
    whole_batch: ClassVar[bool] = False
    #: Methods of the model for planning, which compute what is trained, and which the losses do not call.
    not_called: ClassVar[tuple[str, ...]] = ()

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

    @classmethod
    def check_kind(cls, kind: type[Pretrained] | None, ranks: Ranks) -> None:
        """Checks that the losses call the methods of a class, before there is a checkpoint.

        Raises:
            TypeError: If the class overrides a method that the losses do not call.
        """
        if kind is None:
            return
        for method in cls.not_called:
            if hasattr(kind, method) and is_overridden(kind, method):
                raise TypeError(
                    f"{kind.__name__}.{method}: the losses of this family call the networks of the model and would not call "
                    f"this method; change the networks instead, or add {method} to the class after training"
                )

    def compile(self, compiled: Callable[[Any], Any]) -> None:
        """Compiles the networks of the losses."""

    def __call__(self, batch: Mapping[str, Tensor], sizes: Sequence[int]) -> dict[str, Tensor]:
        """The losses of a batch from the loader; empty if this rank has no clips and computes only its slice.

        Args:
            batch: The slice of this rank: `pixels` `(N, T, 3, H, W)`, `action` `(N, T, A)` in the environment's units, and
                the other columns of the model `(N, T, ..)`.
            sizes: The clips of each rank.
        """
        raise NotImplementedError

    def actions(self, batch: Mapping[str, Tensor]) -> Tensor:
        """The actions `(N, T, A)` in the model's units, of single precision; missing ones (NaN) are 0."""
        action = batch["action"].float()
        return ((action - self.mean.to(action.device)) / self.std.to(action.device)).nan_to_num()

    def train_mode(self) -> None:
        """Switches the model to training: frozen encoders compute as in evaluation."""
        self.model.train()

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
        with unchanged_statistics(self.model) as norms:
            for norm in norms:
                norm.train(self.whole_batch)
            yield

    def share(self, sizes: Sequence[int]) -> float:
        """The factor of this rank's loss in the sum over the ranks."""
        return 1 / self.ranks.size if self.whole_batch else sizes[self.ranks.rank] / sum(sizes)


def windows(x: Tensor, history: int, offset: int) -> Tensor:
    """The runs of `history` steps that another step follows, moved by `offset` steps: `(runs * B, history, ..)`."""
    return torch.cat([x[:, begin + offset : begin + offset + history] for begin in range(x.shape[1] - history)])


@contextmanager
def evaluating(network: Any) -> Iterator[None]:
    """Without dropout."""
    training = network.training
    network.eval()
    try:
        yield
    finally:
        network.train(training)


@contextmanager
def unchanged_statistics(network: nn.Module) -> Iterator[list[Any]]:
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
