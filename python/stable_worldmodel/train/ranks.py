"""`Ranks`: the processes of a distributed training, which `torchrun` starts.

Every process loads a slice of each batch. Gradients of all processes are added up, and are those of one process up to the
order of additions.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

__all__ = ["Ranks"]


class Ranks:
    """The processes of a training; one process without `torchrun`.

    Args:
        rank: The index of this process.
        size: The number of processes.
    """

    def __init__(self, rank: int = 0, size: int = 1) -> None:
        self.rank, self.size = rank, size

    @classmethod
    def join(cls, device: torch.device) -> Ranks:
        """Joins the other processes, whose number `torchrun` says in environment variables."""
        size = int(os.environ.get("WORLD_SIZE", "1"))
        if size > 1 and not dist.is_initialized():
            dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        return cls(dist.get_rank(), dist.get_world_size()) if size > 1 else cls()

    def leave(self) -> None:
        """Leaves the other processes."""
        if self.size > 1 and dist.is_initialized():
            dist.destroy_process_group()

    def first(self, work: Any) -> Any:
        """The result of `work()` of rank 0, on every rank; its error is raised on every rank."""
        if self.size == 1:
            return work()
        outcome: list[Any] = [None, None]
        if self.rank == 0:
            try:
                outcome[0] = work()
            except Exception as error:
                outcome[1] = error
        dist.broadcast_object_list(outcome)
        if outcome[1] is not None:
            raise outcome[1]
        return outcome[0]

    def sizes(self, count: int, device: torch.device) -> list[int]:
        """The `count` of every rank."""
        if self.size == 1:
            return [count]
        found = torch.zeros(self.size, dtype=torch.int64, device=device)
        found[self.rank] = count
        dist.all_reduce(found)
        return [int(n) for n in found.tolist()]

    def gather(self, rows: Tensor | None, sizes: Sequence[int], device: torch.device, *, differentiable: bool = True) -> Tensor:
        """The rows of all ranks, `(sum of sizes, ..)`, in the order of ranks.

        Args:
            rows: The own rows; `None` without any.
            sizes: The number of rows of each rank.
            device: The device of the rows.
            differentiable: Whether gradients flow back to every rank's own rows.
        """
        if self.size == 1:
            assert rows is not None
            return rows
        shape = torch.zeros(8, dtype=torch.int64, device=device)
        if rows is not None:
            shape[: rows.ndim] = torch.tensor(rows.shape)
        dist.all_reduce(shape, dist.ReduceOp.MAX)
        widths = [int(n) for n in shape.tolist()[1:] if n]
        if rows is None:
            rows = torch.zeros(0, *widths, device=device)
        # Every rank takes part in the backward pass of a differentiable gathering, also one without rows.
        if differentiable and torch.is_grad_enabled() and not rows.requires_grad:
            rows = rows.detach().requires_grad_()
        return _Gather.apply(rows.float() if differentiable else rows.detach().float(), list(sizes), self.rank)  # type: ignore[no-any-return]

    def add_up(self, model: nn.Module, values: Tensor) -> Tensor:
        """Adds up the gradients of the model, in place, and the values of all ranks, which are returned.

        A parameter without a gradient on any rank keeps none.
        """
        if self.size == 1:
            return values
        parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
        flat = [torch.zeros_like(p).flatten() if p.grad is None else p.grad.flatten() for p in parameters]
        has = torch.tensor([float(p.grad is not None) for p in parameters], device=values.device)
        total = torch.cat([*(part.float() for part in flat), has, values.float()])
        dist.all_reduce(total)
        summed: Tensor
        *parts, has, summed = total.split([*(p.numel() for p in parameters), len(parameters), len(values)])
        for parameter, part, count in zip(parameters, parts, has.tolist(), strict=True):
            parameter.grad = part.view_as(parameter).to(parameter.dtype) if count else None
        return summed

    def average_buffers(self, model: nn.Module, share: float) -> None:
        """Makes running statistics those of all ranks: their mean, weighted by the ranks' `share` of the batch."""
        if self.size == 1:
            return
        for name, buffer in model.named_buffers():
            if name.endswith(("running_mean", "running_var")):
                buffer.mul_(share)
                dist.all_reduce(buffer)


class _Gather(torch.autograd.Function):
    """The rows of all ranks. The sizes of ranks differ little, so they are padded to the largest."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, sizes: list[int], rank: int) -> Tensor:
        ctx.sizes, ctx.rank = sizes, rank
        padded = rows.new_zeros(max(sizes), *rows.shape[1:])
        padded[: len(rows)] = rows
        parts = [torch.empty_like(padded) for _ in sizes]
        dist.all_gather(parts, padded)
        return torch.cat([part[:size] for part, size in zip(parts, sizes, strict=True)])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Any:
        total = grads[0].contiguous()
        dist.all_reduce(total)
        begin = sum(ctx.sizes[: ctx.rank])
        return total[begin : begin + ctx.sizes[ctx.rank]], None, None
