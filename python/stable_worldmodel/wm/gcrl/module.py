"""The parts of the goal-conditioned models: transformers on the patches of observations and of a goal.

Shapes: B clips, T frames, P patches of a frame, D features of a patch.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from ..lewm.module import FeedForward
from ..prejepa.module import Embedder

__all__ = [
    "Attention",
    "DoublePredictorWrapper",
    "Embedder",
    "ExpectileLoss",
    "FeedForward",
    "MetricValuePredictor",
    "Predictor",
    "QPredictor",
    "SelfAttentionTransformer",
    "Transformer",
    "WithTarget",
]

#: The kinds of attention.
_KINDS = ("self", "cross", "frame_agg")


def _frame_mask(queries: Tensor, keys: Tensor) -> Tensor:
    """The mask `(1, 1, queries, keys)`: whether a key's frame is not later than the query's frame."""
    return (queries[:, None] >= keys[None])[None, None]


class Attention(nn.Module):
    """Attention after a layer normalisation.

    Args:
        dim, heads, dim_head, dropout: Sizes.
        num_patches, num_frames: The tokens of the observations.
        att_type: `"self"`: tokens attend to each other; `"cross"`: to other tokens; `"frame_agg"`: one learned query of each
            frame attends to the tokens, so the result has one token for each frame.
        causal: Whether tokens of later frames are masked; not for `"cross"`.
    """

    causal_mask: Tensor

    def __init__(
        self,
        dim: int,
        heads: int = 8,
        dim_head: int = 64,
        dropout: float = 0.0,
        num_patches: int = 1,
        num_frames: int = 1,
        att_type: str = "self",
        causal: bool = False,
    ) -> None:
        super().__init__()
        if att_type not in _KINDS:
            raise ValueError(f"att_type: {att_type!r}; expected one of {', '.join(_KINDS)}")
        inner = heads * dim_head
        self.heads, self.num_patches, self.att_type = heads, num_patches, att_type
        self.causal = causal and att_type != "cross"
        self.norm, self.dropout = nn.LayerNorm(dim), nn.Dropout(dropout)
        if att_type == "cross":
            self.norm_c = nn.LayerNorm(dim)
        self.to_q = nn.Linear(dim, inner, bias=False)
        self.to_kv = nn.Linear(dim, 2 * inner, bias=False)
        one_full_head = heads == 1 and dim_head == dim
        self.to_out = nn.Identity() if one_full_head else nn.Sequential(nn.Linear(inner, dim), nn.Dropout(dropout))
        if att_type == "frame_agg":
            self.frame_tokens = nn.Parameter(0.02 * torch.randn(1, num_frames, dim))
        if self.causal:
            frames = torch.arange(num_frames)
            tokens = frames.repeat_interleave(num_patches)
            self.register_buffer("causal_mask", _frame_mask(frames if att_type == "frame_agg" else tokens, tokens))

    def forward(self, x: Tensor, c: Tensor | None = None) -> Tensor:
        """Tokens `x` `(B, T * P, dim)` and for `"cross"` the tokens `c` to attend to; `(B, T, dim)` for `"frame_agg"`."""
        x = self.norm(x)
        asked, answered = x, x
        if self.att_type == "cross":
            answered = self.norm_c(c)
        elif self.att_type == "frame_agg":
            asked = self.frame_tokens[:, : x.shape[1] // self.num_patches].expand(len(x), -1, -1)
        keys, values = self.to_kv(answered).chunk(2, -1)
        if keys.shape[1] == 1:
            # All attention goes to the only token, so queries get no gradient.
            return self.to_out(values.expand(-1, asked.shape[1], -1))  # type: ignore[no-any-return]
        parts = (self.to_q(asked), keys, values)
        queries, keys, values = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        mask = self.causal_mask[:, :, : queries.shape[2], : keys.shape[2]] if self.causal else None
        dropout = self.dropout.p if self.training else 0.0
        mixed = nn.functional.scaled_dot_product_attention(queries, keys, values, attn_mask=mask, dropout_p=dropout)
        return self.to_out(mixed.transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


def _layers(kinds: list[str], dim: int, mlp_dim: int, dropout: float, **sizes: Any) -> nn.ModuleList:
    """A pair of attention and linear layers of each kind."""
    pairs = ([Attention(dim, dropout=dropout, att_type=kind, **sizes), FeedForward(dim, mlp_dim, dropout)] for kind in kinds)
    return nn.ModuleList(nn.ModuleList(pair) for pair in pairs)


def _through(layers: Any, x: Tensor, goal: Tensor | None = None) -> Tensor:
    for attention, feed_forward in layers:
        mixed = attention(x, goal if attention.att_type == "cross" else None)
        if attention.att_type == "frame_agg":
            # The number of tokens changes, so nothing is added.
            x = feed_forward(mixed)
        else:
            x = x + mixed
            x = x + feed_forward(x)
    return x


class Transformer(nn.Module):
    """Alternates between self-attention and attention to the goal, and ends with one token for each frame.

    Args:
        dim, depth, heads, dim_head, mlp_dim, dropout, num_patches, num_frames, causal: Sizes, as for `Attention`.
        pool_type: How a frame becomes one token: `"attention"`, or the `"mean"` of its patches.
    """

    def __init__(
        self,
        dim: int,
        depth: int,
        heads: int,
        dim_head: int,
        mlp_dim: int,
        dropout: float = 0.0,
        num_patches: int = 1,
        num_frames: int = 1,
        causal: bool = True,
        pool_type: str = "attention",
    ) -> None:
        super().__init__()
        if pool_type not in ("attention", "mean"):
            raise ValueError(f"pool_type: {pool_type!r}; expected 'attention' or 'mean'")
        self.pool_type, self.num_patches = pool_type, num_patches
        kinds = [("self", "cross")[layer % 2] for layer in range(depth)]
        if pool_type == "attention":
            kinds[-1] = "frame_agg"
        sizes = {"heads": heads, "dim_head": dim_head, "num_patches": num_patches, "num_frames": num_frames}
        self.layers = _layers(kinds, dim, mlp_dim, dropout, causal=causal, **sizes)
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor, g: Tensor) -> Tensor:
        """Observations `x` `(B, T * P, dim)` and goals `g` `(B, P, dim)` to `(B, T, dim)`."""
        x = _through(self.layers, x, g)
        if self.pool_type == "mean":
            x = x.unflatten(1, (-1, self.num_patches)).mean(2)
        return self.norm(x)  # type: ignore[no-any-return]


class SelfAttentionTransformer(nn.Module):
    """Self-attention, then one token for each frame."""

    def __init__(
        self,
        dim: int,
        depth: int,
        heads: int,
        dim_head: int,
        mlp_dim: int,
        dropout: float = 0.0,
        num_patches: int = 1,
        num_frames: int = 1,
        causal: bool = True,
    ) -> None:
        super().__init__()
        self.num_patches, self.num_frames = num_patches, num_frames
        sizes = {"heads": heads, "dim_head": dim_head, "num_patches": num_patches, "num_frames": num_frames}
        kinds = ["self"] * (depth - 1) + ["frame_agg"]
        self.layers = _layers(kinds, dim, mlp_dim, dropout, causal=causal, **sizes)
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> Tensor:
        """`(B, T * P, dim)` to `(B, T, dim)`."""
        return self.norm(_through(self.layers, x))  # type: ignore[no-any-return]


class _GoalConditioned(nn.Module):
    """A `Transformer` with the positions of observations and goals."""

    def __init__(self, num_patches: int, num_frames: int, dim: int, emb_dropout: float, transformer: nn.Module) -> None:
        super().__init__()
        self.num_patches, self.num_frames = num_patches, num_frames
        self.pos_embedding = nn.Parameter(torch.randn(1, num_frames * num_patches, dim))
        self.pos_embedding_goal = nn.Parameter(torch.randn(1, num_patches, dim))
        self.dropout = nn.Dropout(emb_dropout)
        self.transformer = transformer

    def _frames(self, x: Tensor, g: Tensor) -> Tensor:
        """One token for each frame, `(B, T, dim)`."""
        x = self.dropout(x + self.pos_embedding[:, : x.shape[1]])
        return self.transformer(x, g + self.pos_embedding_goal[:, : g.shape[1]])  # type: ignore[no-any-return]


class Predictor(_GoalConditioned):
    """Predicts a vector for each frame from observations and a goal: an action, or a value."""

    def __init__(
        self,
        *,
        num_patches: int,
        num_frames: int,
        dim: int,
        depth: int,
        heads: int,
        mlp_dim: int,
        out_dim: int,
        dim_head: int = 64,
        dropout: float = 0.0,
        emb_dropout: float = 0.0,
        causal: bool = True,
        pool_type: str = "attention",
    ) -> None:
        sizes = (dim, depth, heads, dim_head, mlp_dim, dropout, num_patches, num_frames, causal, pool_type)
        super().__init__(num_patches, num_frames, dim, emb_dropout, Transformer(*sizes))
        self.out_proj = nn.Linear(dim, out_dim)

    def forward(self, x: Tensor, g: Tensor) -> Tensor:
        """Observations `x` `(B, T * P, dim)` and goals `g` `(B, P, dim)` to `(B, T, out_dim)`."""
        return self.out_proj(self._frames(x, g))  # type: ignore[no-any-return]


class QPredictor(_GoalConditioned):
    """Predicts the value of actions for each frame from observations and a goal."""

    def __init__(
        self,
        *,
        num_patches: int,
        num_frames: int,
        dim: int,
        depth: int,
        heads: int,
        mlp_dim: int,
        action_dim: int,
        q_hidden_dim: int = 256,
        dim_head: int = 64,
        dropout: float = 0.0,
        emb_dropout: float = 0.0,
        causal: bool = True,
        pool_type: str = "attention",
    ) -> None:
        sizes = (dim, depth, heads, dim_head, mlp_dim, dropout, num_patches, num_frames, causal, pool_type)
        super().__init__(num_patches, num_frames, dim, emb_dropout, Transformer(*sizes))
        first, second = nn.Linear(dim + action_dim, q_hidden_dim), nn.Linear(q_hidden_dim, q_hidden_dim)
        self.q_head = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), nn.Linear(q_hidden_dim, 1))

    def forward(self, x: Tensor, a: Tensor, g: Tensor) -> Tensor:
        """Observations `x` `(B, T * P, dim)`, actions `a` `(B, T, A)` and goals `g` `(B, P, dim)` to `(B, T, 1)`."""
        return self.q_head(torch.cat([self._frames(x, g), a], -1))  # type: ignore[no-any-return]


class MetricValuePredictor(nn.Module):
    """The value of HILP (Park et al., 2024): the negative distance of observation and goal in a learned space."""

    def __init__(
        self,
        *,
        num_patches: int,
        num_frames: int,
        dim: int,
        depth: int,
        heads: int,
        mlp_dim: int,
        embed_dim: int = 64,
        dim_head: int = 64,
        dropout: float = 0.0,
        emb_dropout: float = 0.0,
        causal: bool = True,
    ) -> None:
        super().__init__()
        self.num_patches, self.num_frames, self.embed_dim = num_patches, num_frames, embed_dim
        self.pos_embedding = nn.Parameter(torch.randn(1, num_frames * num_patches, dim))
        # Part of published weights; goals use the positions of the first frame.
        self.pos_embedding_goal = nn.Parameter(torch.randn(1, num_patches, dim))
        self.dropout = nn.Dropout(emb_dropout)
        sizes = (dim, depth, heads, dim_head, mlp_dim, dropout, num_patches, num_frames, causal)
        self.transformer = SelfAttentionTransformer(*sizes)
        self.embed_proj = nn.Linear(dim, embed_dim)

    def encode(self, x: Tensor) -> Tensor:
        """The points `(B, T, embed_dim)` of frames `(B, T * P, dim)`."""
        return self.embed_proj(self.transformer(self.dropout(x + self.pos_embedding[:, : x.shape[1]])))  # type: ignore[no-any-return]

    def forward(self, x: Tensor, g: Tensor) -> Tensor:
        """Observations `x` `(B, T * P, dim)` and goals `g` `(B, P, dim)` to values `(B, T, 1)`."""
        squares = (self.encode(x) - self.encode(g)).square().sum(-1, keepdim=True)
        # The root has no gradient at 0.
        return -squares.clamp(min=1e-6).sqrt()


class DoublePredictorWrapper(nn.Module):
    """Two predictors of the same kind, for the lower of two estimates.

    Args:
        predictor_cls: Creates a predictor.
        **kwargs: Its arguments.
    """

    def __init__(self, predictor_cls: Callable[..., nn.Module], **kwargs: Any) -> None:
        super().__init__()
        self.net1, self.net2 = predictor_cls(**kwargs), predictor_cls(**kwargs)

    def forward(self, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """The results of both."""
        return self.net1(*args, **kwargs), self.net2(*args, **kwargs)


class WithTarget(nn.Module):
    """A network, `student`, and its target network, `teacher`, which follows it as a moving average.

    Args:
        network: Creates the network.
        **kwargs: Its arguments.
    """

    def __init__(self, network: Callable[..., nn.Module], **kwargs: Any) -> None:
        super().__init__()
        self.student = network(**kwargs)
        self.teacher = copy.deepcopy(self.student).requires_grad_(False)

    def forward(self, *args: Any) -> Any:
        """The result of the network."""
        return self.student(*args)

    @torch.no_grad()
    def update_target(self, keep: float) -> None:
        """Moves the target network: `keep` is the share of its old weights."""
        for old, new in zip(self.teacher.parameters(), self.student.parameters(), strict=True):
            old.lerp_(new, 1 - keep)


class ExpectileLoss(nn.Module):
    """The asymmetric squared error of implicit Q-learning (Kostrikov et al., 2022).

    Args:
        tau: The weight of targets above the prediction; `1 - tau` is that of targets below.
    """

    def __init__(self, tau: float = 0.9) -> None:
        super().__init__()
        self.tau = tau

    def forward(self, preds: Tensor, targets: Tensor, adv: Tensor | None = None) -> Tensor:
        """The mean loss; the sign of `adv`, if it is given, decides the weight."""
        error = targets - preds
        below = (error.detach() if adv is None else adv) < 0
        weight = torch.where(below, abs(self.tau - 1), abs(self.tau))
        return (weight * error.square()).mean()
