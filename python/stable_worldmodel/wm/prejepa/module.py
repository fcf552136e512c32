"""The parts of DINO-WM (`PreJEPA`): pretrained encoders, encoders of other columns, and a frame-causal transformer.

Shapes: B clips, T frames, P patches of a frame, D features of a patch.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from ..lewm.module import FeedForward

__all__ = [
    "BACKBONES",
    "Attention",
    "CausalPredictor",
    "Embedder",
    "FeedForward",
    "PatchDecoder",
    "TimmEncoder",
    "Transformer",
    "create_backbone",
]

#: The names of pretrained encoders on the Hugging Face hub.
BACKBONES = {
    "dino_vitb16": "facebook/dino-vitb16",
    "dino_vitb8": "facebook/dino-vitb8",
    "dino_vits16": "facebook/dino-vits16",
    "dino_vits8": "facebook/dino-vits8",
    "dinov2_base": "facebook/dinov2-base",
    "dinov2_giant": "facebook/dinov2-giant",
    "dinov2_large": "facebook/dinov2-large",
    "dinov2_small": "facebook/dinov2-small",
    "dinov3_small": "facebook/dinov3-vits16-pretrain-lvd1689m",
    "ijepa_huge": "facebook/ijepa-huge-patch14-224",
    "mae_base": "facebook/vit-mae-base",
    "mae_huge": "facebook/vit-mae-huge",
    "mae_large": "facebook/vit-mae-large",
    "resnet_101": "microsoft/resnet-101",
    "resnet_50": "microsoft/resnet-50",
    "siglip2_base_224": "google/siglip2-base-patch16-224",
    "siglip2_large_256": "google/siglip2-large-patch16-256",
    "vit_base_patch16": "google/vit-base-patch16-224",
    "vit_large_patch16": "google/vit-large-patch16-224",
    "vjepa2_huge": "facebook/vjepa2-vit-h",
    "vjepa2_large": "facebook/vjepa2-vit-l",
    "webssl_large": "facebook/webssl-vith14-5b",
}


def create_backbone(name: str) -> nn.Module:
    """Loads a pretrained image encoder with `transformers`, or with `timm`.

    Args:
        name: A key of `BACKBONES`, or a name on the Hugging Face hub. The classifier of a ResNet is replaced by a layer
            normalisation, so that its `logits` are features. A masked autoencoder encodes all patches, in their order. Names
            such as `timm/vit_small_patch16_224.augreg_in1k` are those of `timm`, which gives a `TimmEncoder`.

    Raises:
        ModuleNotFoundError: If `transformers` or `timm` is not installed.
    """
    if name.startswith("timm/"):
        return TimmEncoder(name.removeprefix("timm/"))
    try:
        import transformers
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{error}; pretrained encoders need it: pip install transformers") from error

    name = BACKBONES.get(name, name)
    if name.startswith("microsoft/resnet-"):
        network: Any = transformers.AutoModelForImageClassification.from_pretrained(name)
        network.classifier[1] = nn.LayerNorm(network.config.hidden_sizes[-1])
        return network  # type: ignore[no-any-return]
    network = transformers.AutoModel.from_pretrained(name)
    if hasattr(getattr(network, "embeddings", None), "random_masking"):
        network.embeddings.random_masking = _unmasked
    # Models of images and texts have an encoder for each.
    return getattr(network, "vision_model", network)  # type: ignore[no-any-return]


class TimmEncoder(nn.Module):
    """An image encoder of `timm` without its classifier: a transformer, or a convolutional network.

    Args:
        name: The name of the model and of its weights.
        **settings: Further arguments of `timm.create_model`, such as `pretrained=False`.
    """

    def __init__(self, name: str, **settings: Any) -> None:
        super().__init__()
        try:
            import timm
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(f"{error}; the encoder timm/{name} needs it: pip install timm") from error
        settings = {"pretrained": True, "num_classes": 0, **settings}
        try:
            # Images may have another size than those of the training.
            self.network: Any = timm.create_model(name, dynamic_img_size=True, **settings)
        except TypeError:
            self.network = timm.create_model(name, **settings)

    def patches(self, images: Tensor) -> Tensor:
        """Images `(B, 3, H, W)` to the features of the patches, or of the places of the last map, `(B, P, D)`."""
        (features,) = self.network.forward_intermediates(
            images, indices=1, norm=True, output_fmt="NCHW", intermediates_only=True
        )
        return features.flatten(2).transpose(1, 2)  # type: ignore[no-any-return]

    def forward(self, x: Tensor) -> Tensor:
        """As `patches`."""
        return self.patches(x)


def _unmasked(sequence: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """The masking of a masked autoencoder that keeps all patches `(B, P, D)`: the patches, the mask, and their order."""
    order = torch.arange(sequence.shape[1], device=sequence.device).expand(len(sequence), -1)
    return sequence, torch.zeros_like(order, dtype=sequence.dtype), order


class Embedder(nn.Module):
    """Encodes a column of numbers, or actions."""

    def __init__(self, num_frames: int = 1, tubelet_size: int = 1, in_chans: int = 8, emb_dim: int = 10) -> None:
        super().__init__()
        self.num_frames, self.tubelet_size, self.in_chans, self.emb_dim = num_frames, tubelet_size, in_chans, emb_dim
        self.patch_embed = nn.Conv1d(in_chans, emb_dim, tubelet_size, stride=tubelet_size)

    def forward(self, x: Tensor) -> Tensor:
        """`(B, T, in_chans)` to `(B, T / tubelet_size, emb_dim)`, in full precision."""
        with torch.autocast(x.device.type, enabled=False):
            return self.patch_embed(x.transpose(1, 2)).transpose(1, 2)  # type: ignore[no-any-return]


class Attention(nn.Module):
    """Self-attention in which a patch attends to all patches of its own and of earlier frames."""

    bias: Tensor

    def __init__(
        self,
        dim: int,
        heads: int = 8,
        dim_head: int = 64,
        dropout: float = 0.0,
        num_patches: int = 1,
        num_frames: int = 1,
    ) -> None:
        super().__init__()
        inner = heads * dim_head
        self.heads = heads
        self.norm, self.dropout = nn.LayerNorm(dim), nn.Dropout(dropout)
        self.to_qkv = nn.Linear(dim, 3 * inner, bias=False)
        one_full_head = heads == 1 and dim_head == dim
        self.to_out = nn.Identity() if one_full_head else nn.Sequential(nn.Linear(inner, dim), nn.Dropout(dropout))
        self.register_buffer("bias", self.generate_mask_matrix(num_patches, num_frames))

    def generate_mask_matrix(self, npatch: int, nwindow: int) -> Tensor:
        """The mask `(1, 1, tokens, tokens)`: 1 where a token attends to another one."""
        frame = torch.arange(npatch * nwindow) // npatch
        return (frame[:, None] >= frame[None]).float()[None, None]

    def forward(self, x: Tensor) -> Tensor:
        """`(B, T * P, dim)` to `(B, T * P, dim)`."""
        tokens = x.shape[1]
        parts = self.to_qkv(self.norm(x)).chunk(3, -1)
        queries, keys, values = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        mask = self.bias[:, :, :tokens, :tokens] == 1
        dropout = self.dropout.p if self.training else 0.0
        mixed = nn.functional.scaled_dot_product_attention(queries, keys, values, attn_mask=mask, dropout_p=dropout)
        return self.to_out(mixed.transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class Transformer(nn.Module):
    """Pairs of attention and linear layers, each added to its input."""

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
    ) -> None:
        super().__init__()
        sizes = (dim, heads, dim_head, dropout, num_patches, num_frames)
        layers = ([Attention(*sizes), FeedForward(dim, mlp_dim, dropout)] for _ in range(depth))
        self.layers = nn.ModuleList(nn.ModuleList(pair) for pair in layers)
        self.norm = nn.LayerNorm(dim)

    def forward(self, x: Tensor) -> Tensor:
        """`(B, T * P, dim)` to `(B, T * P, dim)`."""
        layers: Any = self.layers
        for attention, feed_forward in layers:
            x = x + attention(x)
            x = x + feed_forward(x)
        return self.norm(x)  # type: ignore[no-any-return]


class CausalPredictor(nn.Module):
    """Predicts the patches of the next frame from those of at most `num_frames` frames."""

    def __init__(
        self,
        *,
        num_patches: int,
        num_frames: int,
        dim: int,
        depth: int,
        heads: int,
        mlp_dim: int,
        pool: str = "cls",
        dim_head: int = 64,
        dropout: float = 0.0,
        emb_dropout: float = 0.0,
        **kwargs: Any,
    ) -> None:
        super().__init__()
        if pool not in ("cls", "mean"):
            raise ValueError(f"CausalPredictor: pool={pool!r}; expected 'cls' or 'mean', which have the same effect")
        self.num_patches, self.num_frames, self.pool = num_patches, num_frames, pool
        self.pos_embedding = nn.Parameter(torch.randn(1, num_frames * num_patches, dim))
        self.dropout = nn.Dropout(emb_dropout)
        self.transformer = Transformer(dim, depth, heads, dim_head, mlp_dim, dropout, num_patches, num_frames)

    def forward(self, x: Tensor) -> Tensor:
        """Frame by frame `(B, T * P, dim)` to the frames after each of them, `(B, T * P, dim)`."""
        return self.transformer(self.dropout(x + self.pos_embedding[:, : x.shape[1]]))  # type: ignore[no-any-return]


class PatchDecoder(nn.Module):
    """Reconstructs images from the features of their patches: two linear layers for each patch."""

    def __init__(self, features: int, hidden: int, patch: int) -> None:
        super().__init__()
        self.patch = patch
        self.hidden, self.pixels = nn.Linear(features, hidden), nn.Linear(hidden, 3 * patch**2)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Features `(B, T, P, D)` to normalised images `(B * T, 3, H, W)`, and a loss of zero."""
        patches = self.pixels(nn.functional.gelu(self.hidden(x))).flatten(0, 1)
        side = round(patches.shape[1] ** 0.5)
        rows = patches.unflatten(-1, (3, self.patch, self.patch)).unflatten(1, (side, side))
        return rows.permute(0, 3, 1, 4, 2, 5).flatten(4, 5).flatten(2, 3), x.new_zeros(())
