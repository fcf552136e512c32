"""`roll`: the predictions of a plan, step by step, without the work that `Predictor` repeats at every step.

Shapes: N candidates, T steps, D the latent dimension.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules import module

from ..._overrides import is_overridden
from .module import Attention, ConditionalBlock, FeedForward, Predictor, Transformer, modulate

__all__ = ["roll", "rolls"]

#: The number of keys up to which a GPU computes attention as sums of products.
_FEW = 8
#: The classes whose forward passes `roll` stands in for.
_STOOD_IN_FOR = (Predictor, Transformer, ConditionalBlock, Attention)
#: The classes of the parts of a predictor. `roll` calls the others for fewer steps at once than `Predictor` does.
_KNOWN = frozenset(
    {
        *_STOOD_IN_FOR,
        FeedForward,
        nn.Dropout,
        nn.GELU,
        nn.Identity,
        nn.LayerNorm,
        nn.Linear,
        nn.ModuleList,
        nn.Sequential,
        nn.SiLU,
    }
)


def rolls(predictor: nn.Module) -> bool:
    """Whether `roll` computes what a predictor computes: not if it trains (dropout), was changed, compiled or has hooks."""
    if torch.compiler.is_compiling():
        # The whole check cannot be compiled.
        return type(predictor) is Predictor and not predictor.training
    if module._global_forward_hooks or module._global_forward_pre_hooks:
        return False
    if any(is_overridden(kind, "forward") for kind in _STOOD_IN_FOR):
        return False
    return _has_its_parts(predictor) and all(map(_is_unchanged, predictor.modules()))


def _has_its_parts(predictor: nn.Module) -> bool:
    """Whether the parts whose forward passes `roll` stands in for are those that `Predictor` builds."""
    if type(predictor) is not Predictor or type(predictor.transformer) is not Transformer:
        return False
    blocks: Any = list(predictor.transformer.layers)
    if any(type(block) is not ConditionalBlock or type(block.attn) is not Attention for block in blocks):
        return False
    products = [block.attn.to_qkv for block in blocks]
    has_products = all(type(product) is nn.Linear and product.bias is None for product in products)
    return has_products and type(predictor.dropout) is nn.Dropout


def _is_unchanged(part: nn.Module) -> bool:
    """Whether a part computes what its class says, for each step on its own."""
    hooks = (part._forward_hooks, part._forward_pre_hooks, part._backward_hooks, part._backward_pre_hooks)
    compiled = getattr(part, "_compiled_call_impl", None) is not None
    return type(part) in _KNOWN and not (part.training or "forward" in part.__dict__ or compiled or any(hooks))


def roll(predictor: Predictor, observed: Tensor, actions: Tensor, project: Callable[[Tensor], Tensor], history: int) -> Tensor:
    """The latents `(N, T, D)` of the observed frames, and of the predictions for the actions from the last frame on.

    The results are those of `predictor` on the last `history` latents, up to rounding: modulations of all steps are one
    product, keys and values are kept while the window grows, and the last layer computes the last token alone.

    Args:
        predictor: The predictor, in evaluation mode.
        observed: The latents of the observed frames, `(N, frames, D)`.
        actions: The encoded actions `(N, frames - 1 + predictions, D)`, beginning with those between the frames.
        project: Maps outputs of the predictor `(N, D)` to latents.
        history: The number of latents that the predictor gets, at most its `num_frames`.
    """
    transformer: Any = predictor.transformer
    conditions = transformer.cond_proj(actions)
    # For each layer, shift, scale and gate of attention and of the two linear layers, `(N, T, dim)` each.
    modulations = [layer.adaLN_modulation(conditions).chunk(6, -1) for layer in transformer.layers]
    latents = list(observed.unbind(1))
    window = _Window(predictor, modulations)
    for now in range(len(latents), actions.shape[1] + 1):
        begin = max(0, now - history)
        if begin != window.begin or window.size == 0:
            window.move(begin)
        added = torch.stack(latents[begin + window.size : now], 1)
        latents.append(project(window.extend(added)))
    return torch.stack(latents, 1)


class _Window:
    """The keys and values of the latents that a prediction sees."""

    def __init__(self, predictor: Predictor, modulations: list[tuple[Tensor, ...]]) -> None:
        self.predictor, self.modulations = predictor, modulations
        self.begin, self.size = 0, 0
        self.known: list[tuple[Tensor, Tensor]] = []

    def move(self, begin: int) -> None:
        """Empties the window, which then begins at step `begin`: positions are counted from there."""
        self.begin, self.size, self.known = begin, 0, []

    def extend(self, added: Tensor) -> Tensor:
        """Adds latents `(N, n, D)`, and returns the predictor's output `(N, D)` for the last of them."""
        transformer: Any = self.predictor.transformer
        first, count = self.size, added.shape[1]
        x = transformer.input_proj(added + self.predictor.pos_embedding[:, first : first + count])
        steps = slice(self.begin + first, self.begin + first + count)
        for index, layer in enumerate(transformer.layers):
            parts = [part[:, steps] for part in self.modulations[index]]
            if index + 1 == len(transformer.layers):
                x = self._layer(index, layer, x, parts, last_only=True)
            else:
                x = self._layer(index, layer, x, parts)
        self.size += count
        return transformer.output_proj(transformer.norm(x[:, -1]))  # type: ignore[no-any-return]

    def _layer(self, index: int, layer: ConditionalBlock, x: Tensor, parts: list[Tensor], last_only: bool = False) -> Tensor:
        attention = layer.attn
        normed = attention.norm(modulate(layer.norm1(x), parts[0], parts[1]))
        if last_only:
            x, parts = x[:, -1:], [part[:, -1:] for part in parts]
        weight = attention.to_qkv.weight
        inner = weight.shape[0] // 3
        heads = (attention.heads, -1)
        queries = nn.functional.linear(normed[:, -x.shape[1] :], weight[:inner]).unflatten(-1, heads).transpose(1, 2)
        keys, values = (
            part.unflatten(-1, heads).transpose(1, 2) for part in nn.functional.linear(normed, weight[inner:]).chunk(2, -1)
        )
        if index < len(self.known):
            keys, values = (torch.cat(pair, 2) for pair in zip(self.known[index], (keys, values), strict=True))
            self.known[index] = (keys, values)
        else:
            self.known.append((keys, values))
        mixed = _attended(queries, keys, values)
        x = x + parts[2] * attention.to_out(mixed.transpose(1, 2).flatten(2))
        return x + parts[5] * layer.mlp(modulate(layer.norm2(x), parts[3], parts[4]))  # type: ignore[no-any-return]


def _attended(queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
    """The attention of `(N, heads, n, d)` queries; several queries are those of a window that was empty, and causal."""
    count, known = queries.shape[2], keys.shape[2]
    if not queries.is_cuda or known > _FEW:
        return nn.functional.scaled_dot_product_attention(queries, keys, values, is_causal=count > 1)
    # Kernels of attention are for long sequences: with three keys, they take two thirds of a plan.
    scores = (queries.unsqueeze(3) * keys.unsqueeze(2)).sum(-1) * queries.shape[3] ** -0.5
    if count > 1:
        later = torch.ones(count, known, dtype=torch.bool, device=scores.device).triu(1)
        scores = scores.masked_fill(later, -torch.inf)
    mixed: Tensor = (scores.softmax(-1).unsqueeze(-1) * values.unsqueeze(2)).sum(3)
    return mixed
