"""The parts of a LeWM: an action encoder, projections, and a causal transformer that actions modulate.

Shapes: B clips, T steps, D the latent dimension.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

__all__ = [
    "MLP",
    "Attention",
    "Block",
    "ConditionalBlock",
    "Embedder",
    "FeedForward",
    "Predictor",
    "Transformer",
    "detach_clone",
    "modulate",
]


def detach_clone(v: Any) -> Any:
    """A copy of a tensor without its graph; other values unchanged."""
    return v.detach().clone() if torch.is_tensor(v) else v


def modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """Scales by `1 + scale`, then shifts (adaptive layer normalisation, Peebles and Xie, 2023)."""
    return x * (1 + scale) + shift


class FeedForward(nn.Module):
    """Two linear layers after a layer normalisation."""

    def __init__(self, dim: int, hidden_dim: int, dropout: float = 0.0) -> None:
        super().__init__()
        widen, narrow = nn.Linear(dim, hidden_dim), nn.Linear(hidden_dim, dim)
        self.net = nn.Sequential(nn.LayerNorm(dim), widen, nn.GELU(), nn.Dropout(dropout), narrow, nn.Dropout(dropout))

    def forward(self, x: Tensor) -> Tensor:
        """`(.., dim)` to `(.., dim)`."""
        return self.net(x)  # type: ignore[no-any-return]


class Attention(nn.Module):
    """Self-attention after a layer normalisation; causal unless stated otherwise."""

    def __init__(self, dim: int, heads: int = 8, dim_head: int = 64, dropout: float = 0.0) -> None:
        super().__init__()
        inner = heads * dim_head
        self.heads, self.dropout = heads, dropout
        self.norm = nn.LayerNorm(dim)
        self.to_qkv = nn.Linear(dim, 3 * inner, bias=False)
        one_full_head = heads == 1 and dim_head == dim
        self.to_out = nn.Identity() if one_full_head else nn.Sequential(nn.Linear(inner, dim), nn.Dropout(dropout))

    def forward(self, x: Tensor, causal: bool = True) -> Tensor:
        """`(B, T, dim)` to `(B, T, dim)`."""
        queries, keys, values = (
            part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in self.to_qkv(self.norm(x)).chunk(3, -1)
        )
        dropout = self.dropout if self.training else 0.0
        mixed = nn.functional.scaled_dot_product_attention(queries, keys, values, dropout_p=dropout, is_causal=causal)
        return self.to_out(mixed.transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class Block(nn.Module):
    """A transformer block: attention, then two linear layers, each added to its input."""

    def __init__(self, dim: int, heads: int, dim_head: int, mlp_dim: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.attn = Attention(dim, heads, dim_head, dropout)
        self.mlp = FeedForward(dim, mlp_dim, dropout)
        self.norm1 = nn.LayerNorm(dim, eps=1e-6, elementwise_affine=False)
        self.norm2 = nn.LayerNorm(dim, eps=1e-6, elementwise_affine=False)

    def forward(self, x: Tensor) -> Tensor:
        """`(B, T, dim)` to `(B, T, dim)`."""
        x = x + self.attn(self.norm1(x))
        return x + self.mlp(self.norm2(x))  # type: ignore[no-any-return]


class ConditionalBlock(Block):
    """A block whose layers a condition shifts, scales and gates. It is the identity before training (zero gates)."""

    def __init__(self, dim: int, heads: int, dim_head: int, mlp_dim: int, dropout: float = 0.0) -> None:
        super().__init__(dim, heads, dim_head, mlp_dim, dropout)
        gates = nn.Linear(dim, 6 * dim)
        nn.init.zeros_(gates.weight)
        nn.init.zeros_(gates.bias)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), gates)

    def forward(self, x: Tensor, c: Tensor) -> Tensor:  # type: ignore[override]
        """`x` and `c` `(B, T, dim)` to `(B, T, dim)`."""
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = self.adaLN_modulation(c).chunk(6, -1)
        x = x + gate_a * self.attn(modulate(self.norm1(x), shift_a, scale_a))
        return x + gate_m * self.mlp(modulate(self.norm2(x), shift_m, scale_m))  # type: ignore[no-any-return]


def _linear(inputs: int, outputs: int) -> nn.Module:
    return nn.Identity() if inputs == outputs else nn.Linear(inputs, outputs)


class Transformer(nn.Module):
    """Blocks between two linear layers, which are left out where the sizes are equal."""

    def __init__(
        self,
        input_dim: int,
        hidden_dim: int,
        output_dim: int,
        depth: int,
        heads: int,
        dim_head: int,
        mlp_dim: int,
        dropout: float = 0.0,
        block_class: type[Block] = Block,
    ) -> None:
        super().__init__()
        self.input_proj, self.cond_proj = _linear(input_dim, hidden_dim), _linear(input_dim, hidden_dim)
        self.layers = nn.ModuleList(block_class(hidden_dim, heads, dim_head, mlp_dim, dropout) for _ in range(depth))
        self.norm = nn.LayerNorm(hidden_dim)
        self.output_proj = _linear(hidden_dim, output_dim)

    def forward(self, x: Tensor, c: Tensor | None = None) -> Tensor:
        """`x` and the condition `c` `(B, T, input_dim)` to `(B, T, output_dim)`."""
        x = self.input_proj(x)
        condition = () if c is None else (self.cond_proj(c),)
        for layer in self.layers:
            x = layer(x, *condition) if isinstance(layer, ConditionalBlock) else layer(x)
        return self.output_proj(self.norm(x))  # type: ignore[no-any-return]


class Embedder(nn.Module):
    """Encodes the actions of a model step."""

    def __init__(self, input_dim: int = 10, smoothed_dim: int = 10, emb_dim: int = 10, mlp_scale: int = 4) -> None:
        super().__init__()
        self.input_dim, self.smoothed_dim, self.emb_dim = input_dim, smoothed_dim, emb_dim
        self.patch_embed = nn.Conv1d(input_dim, smoothed_dim, 1)
        hidden = mlp_scale * emb_dim
        self.embed = nn.Sequential(nn.Linear(smoothed_dim, hidden), nn.SiLU(), nn.Linear(hidden, emb_dim))

    def forward(self, x: Tensor) -> Tensor:
        """Actions `(B, T, input_dim)` to embeddings `(B, T, emb_dim)`."""
        smoothed = self.patch_embed(x.to(self.patch_embed.weight.dtype).transpose(1, 2))
        return self.embed(smoothed.transpose(1, 2))  # type: ignore[no-any-return]


class MLP(nn.Module):
    """Two linear layers with a normalisation between them."""

    def __init__(
        self,
        input_dim: int,
        hidden_dim: int,
        output_dim: int | None = None,
        norm_fn: Callable[[int], nn.Module] | None = nn.LayerNorm,
        act_fn: Callable[[], nn.Module] = nn.GELU,
    ) -> None:
        super().__init__()
        self.input_dim, self.hidden_dim, self.output_dim = input_dim, hidden_dim, output_dim or input_dim
        norm = nn.Identity() if norm_fn is None else norm_fn(hidden_dim)
        self.net = nn.Sequential(nn.Linear(input_dim, hidden_dim), norm, act_fn(), nn.Linear(hidden_dim, self.output_dim))

    def forward(self, x: Tensor) -> Tensor:
        """`(N, input_dim)` to `(N, output_dim)`."""
        return self.net(x)  # type: ignore[no-any-return]


class Predictor(nn.Module):
    """Predicts the next latent from at most `num_frames` latents and the actions taken from them."""

    def __init__(
        self,
        *,
        num_frames: int,
        depth: int,
        heads: int,
        mlp_dim: int,
        input_dim: int,
        hidden_dim: int,
        output_dim: int | None = None,
        dim_head: int = 64,
        dropout: float = 0.0,
        emb_dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.num_frames = num_frames
        self.pos_embedding = nn.Parameter(torch.randn(1, num_frames, input_dim))
        self.dropout = nn.Dropout(emb_dropout)
        sizes = (input_dim, hidden_dim, output_dim or input_dim, depth, heads, dim_head, mlp_dim)
        self.transformer = Transformer(*sizes, dropout, block_class=ConditionalBlock)

    def forward(self, x: Tensor, c: Tensor) -> Tensor:
        """Latents `x` and encoded actions `c` `(B, T, D)` to the next latents `(B, T, D)`."""
        x = self.dropout(x + self.pos_embedding[:, : x.shape[1]])
        return self.transformer(x, c)  # type: ignore[no-any-return]
