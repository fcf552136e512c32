"""Image encoders of the engine's checkpoints, as modules with the same weight names.

All map normalised frames `(N, 3, H, W)` to features; `ViT` and `Dinov2` return an object with `last_hidden_state`, as the
vision transformers of `transformers` do. `patches` returns the features of each patch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["Convolutions", "Dinov2", "Keypoints", "Pyramid", "ViT", "encoder_of"]

_ACTIVATIONS = {"relu": nn.functional.relu, "gelu": nn.functional.gelu, "silu": nn.functional.silu}


def _tree(**parts: nn.Module) -> nn.Module:
    """A module with these parts, which give the weights their published names."""
    module = nn.Module()
    for name, part in parts.items():
        setattr(module, name, part)
    return module


class ViT(nn.Module):
    """A vision transformer (Dosovitskiy et al., 2021) with the weight names of published files.

    Args:
        image: Side of the images in pixels.
        patch: Side of the patches.
        dim: Features of a token.
        depth: Layers.
        heads: Attention heads.
        mlp: Hidden features of a layer.
        mask_token: Whether there is a token for masked patches, which has no effect here.
    """

    def __init__(self, image: int, patch: int, dim: int, depth: int, heads: int, mlp: int, mask_token: bool = False) -> None:
        super().__init__()
        self.patch, self.heads = patch, heads
        self.embeddings = _tree(patch_embeddings=_tree(projection=nn.Conv2d(3, dim, patch, patch)))
        self.embeddings.cls_token = nn.Parameter(0.02 * torch.randn(1, 1, dim))
        self.embeddings.position_embeddings = nn.Parameter(0.02 * torch.randn(1, (image // patch) ** 2 + 1, dim))
        if mask_token:
            self.embeddings.mask_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.encoder = _tree(layer=nn.ModuleList(self._layer(dim, mlp) for _ in range(depth)))
        self.layernorm = nn.LayerNorm(dim, eps=1e-12)

    @staticmethod
    def _layer(dim: int, mlp: int) -> nn.Module:
        projections = _tree(query=nn.Linear(dim, dim), key=nn.Linear(dim, dim), value=nn.Linear(dim, dim))
        return _tree(
            layernorm_before=nn.LayerNorm(dim, eps=1e-12),
            attention=_tree(attention=projections, output=_tree(dense=nn.Linear(dim, dim))),
            layernorm_after=nn.LayerNorm(dim, eps=1e-12),
            intermediate=_tree(dense=nn.Linear(dim, mlp)),
            output=_tree(dense=nn.Linear(mlp, dim)),
        )

    def forward(self, pixels: Tensor, interpolate_pos_encoding: bool = True) -> Any:
        """Frames `(N, 3, H, W)` to tokens `last_hidden_state` `(N, 1 + patches, dim)`, the class token first."""
        embeddings: Any = self.embeddings
        patches = embeddings.patch_embeddings.projection(pixels)
        tokens = patches.flatten(2).transpose(1, 2)
        positions = _positions(embeddings.position_embeddings, patches.shape[2:])
        x = torch.cat([embeddings.cls_token.expand(len(tokens), -1, -1), tokens], 1) + positions
        layers: Any = self.encoder.layer
        for layer in layers:
            x = x + _attended(layer.attention, layer.layernorm_before(x), self.heads)
            hidden = nn.functional.gelu(layer.intermediate.dense(layer.layernorm_after(x)))
            x = x + layer.output.dense(hidden)
        return SimpleNamespace(last_hidden_state=self.layernorm(x))

    def patches(self, frames: Tensor) -> Tensor:
        """Frames `(N, 3, H, W)` to the features of their patches `(N, patches, dim)`."""
        return self(frames).last_hidden_state[:, 1:]  # type: ignore[no-any-return]


class Dinov2(nn.Module):
    """DINOv2 (Oquab et al., 2023), with or without registers, with the weight names of published files.

    Args:
        image: Side of the images in pixels.
        patch: Side of the patches.
        dim: Features of a token.
        depth: Layers.
        heads: Attention heads.
        mlp: Hidden features of a layer.
        grid: Side of the grid of patches that the position embeddings belong to.
        registers: Tokens that stand for no patch.
    """

    def __init__(
        self, image: int, patch: int, dim: int, depth: int, heads: int, mlp: int, grid: int, registers: int = 0
    ) -> None:
        super().__init__()
        self.heads, self.registers = heads, registers
        self.embeddings = _tree(patch_embeddings=_tree(projection=nn.Conv2d(3, dim, patch, patch)))
        self.embeddings.cls_token = nn.Parameter(0.02 * torch.randn(1, 1, dim))
        self.embeddings.mask_token = nn.Parameter(torch.zeros(1, dim))
        self.embeddings.position_embeddings = nn.Parameter(0.02 * torch.randn(1, grid**2 + 1, dim))
        if registers:
            self.embeddings.register_tokens = nn.Parameter(0.02 * torch.randn(1, registers, dim))
        self.encoder = _tree(layer=nn.ModuleList(self._layer(dim, mlp) for _ in range(depth)))
        self.layernorm = nn.LayerNorm(dim, eps=1e-6)

    @staticmethod
    def _layer(dim: int, mlp: int) -> nn.Module:
        projections = _tree(query=nn.Linear(dim, dim), key=nn.Linear(dim, dim), value=nn.Linear(dim, dim))
        layer = _tree(
            norm1=nn.LayerNorm(dim, eps=1e-6),
            attention=_tree(attention=projections, output=_tree(dense=nn.Linear(dim, dim))),
            layer_scale1=nn.Module(),
            norm2=nn.LayerNorm(dim, eps=1e-6),
            mlp=_tree(fc1=nn.Linear(dim, mlp), fc2=nn.Linear(mlp, dim)),
            layer_scale2=nn.Module(),
        )
        for scale in (layer.layer_scale1, layer.layer_scale2):
            scale.lambda1 = nn.Parameter(torch.ones(dim))  # type: ignore[union-attr]
        return layer

    def forward(self, pixels: Tensor, interpolate_pos_encoding: bool = True) -> Any:
        """Frames `(N, 3, H, W)` to tokens `last_hidden_state` `(N, 1 + registers + patches, dim)`, the class token first."""
        embeddings: Any = self.embeddings
        patches = embeddings.patch_embeddings.projection(pixels)
        tokens = patches.flatten(2).transpose(1, 2)
        positions = _positions(embeddings.position_embeddings, patches.shape[2:], antialias=self.registers > 0)
        x = torch.cat([embeddings.cls_token.expand(len(tokens), -1, -1), tokens], 1) + positions
        if self.registers:
            x = torch.cat([x[:, :1], embeddings.register_tokens.expand(len(x), -1, -1), x[:, 1:]], 1)
        layers: Any = self.encoder.layer
        for layer in layers:
            x = x + layer.layer_scale1.lambda1 * _attended(layer.attention, layer.norm1(x), self.heads)
            x = x + layer.layer_scale2.lambda1 * layer.mlp.fc2(nn.functional.gelu(layer.mlp.fc1(layer.norm2(x))))
        return SimpleNamespace(last_hidden_state=self.layernorm(x))

    def patches(self, frames: Tensor) -> Tensor:
        """Frames `(N, 3, H, W)` to the features of their patches `(N, patches, dim)`."""
        return self(frames).last_hidden_state[:, 1 + self.registers :]  # type: ignore[no-any-return]


def _positions(known: Tensor, size: Sequence[int], antialias: bool = False) -> Tensor:
    """The position embeddings, interpolated to another number of patches."""
    side = round((known.shape[1] - 1) ** 0.5)
    if tuple(size) == (side, side):
        return known
    grid = known[:, 1:].transpose(1, 2).unflatten(2, (side, side))
    grid = nn.functional.interpolate(grid, tuple(size), mode="bicubic", align_corners=False, antialias=antialias)
    return torch.cat([known[:, :1], grid.flatten(2).transpose(1, 2)], 1)


def _attended(attention: Any, x: Tensor, heads: int) -> Tensor:
    """Self-attention of normalised tokens `(N, tokens, dim)`."""
    part = attention.attention
    split = (p(x).unflatten(-1, (heads, -1)).transpose(1, 2) for p in (part.query, part.key, part.value))
    mixed = nn.functional.scaled_dot_product_attention(*split)
    return attention.output.dense(mixed.transpose(1, 2).flatten(2))  # type: ignore[no-any-return]


class Pyramid(nn.Module):
    """Convolutions of disjoint patches, then two linear layers: small and fast.

    Args:
        image: Side of the images in pixels.
        stages: The `patch` and `channels` of each stage.
        hidden: Features between the linear layers.
        dim: Features of an image.
        activation: `relu`, `gelu` or `silu`.
    """

    takes_frames = True

    def __init__(
        self, image: int, stages: Sequence[Mapping[str, int]], hidden: int, dim: int, activation: str = "relu"
    ) -> None:
        super().__init__()
        first, *later = stages
        self.sides = [stage["patch"] for stage in later]
        self.activation: Any = _ACTIVATIONS[activation]
        self.stem = nn.Conv2d(3, first["channels"], first["patch"], first["patch"])
        inputs, side, self.stages = first["channels"], image // first["patch"], nn.ModuleList()
        for stage in later:
            self.stages.append(nn.Linear(stage["patch"] ** 2 * inputs, stage["channels"]))
            inputs, side = stage["channels"], side // stage["patch"]
        self.hidden, self.out = nn.Linear(side**2 * inputs, hidden), nn.Linear(hidden, dim)

    def forward(self, frames: Tensor) -> Tensor:
        """Frames `(N, 3, H, W)` to features `(N, dim)`."""
        x = self.activation(self.stem(frames)).movedim(1, -1)
        for layer, patch in zip(self.stages, self.sides, strict=True):
            count, side, _, channels = x.shape
            blocks = x.reshape(count, side // patch, patch, side // patch, patch * channels).transpose(2, 3)
            x = self.activation(layer(blocks.reshape(count, side // patch, side // patch, -1)))
        return self.out(self.activation(self.hidden(x.flatten(1))))  # type: ignore[no-any-return]

    def patches(self, frames: Tensor) -> Tensor:
        """Frames `(N, 3, H, W)` to the features of the image as one patch, `(N, 1, dim)`."""
        return self(frames).unsqueeze(1)  # type: ignore[no-any-return]


class Convolutions(nn.Module):
    """Overlapping 3 x 3 convolutions that halve the side, each with batch normalisation, then one or two linear layers.

    Args:
        image: Side of the images in pixels.
        channels: Output channels of each convolution.
        hidden: Features between the linear layers; 0 for one linear layer.
        dim: Features of an image.
    """

    takes_frames = True

    def __init__(self, image: int, channels: Sequence[int], dim: int, hidden: int = 0) -> None:
        super().__init__()
        inputs, self.stages, side = 3, nn.ModuleList(), image
        for outputs in channels:
            convolution = nn.Conv2d(inputs, outputs, 3, stride=2, padding=1, bias=False)
            self.stages.append(_tree(conv=convolution, norm=nn.BatchNorm2d(outputs)))
            inputs, side = outputs, -(-side // 2)
        features = side**2 * inputs
        self.hidden = nn.Linear(features, hidden) if hidden else None
        self.out = nn.Linear(hidden or features, dim)

    def forward(self, frames: Tensor) -> Tensor:
        """Frames `(N, 3, H, W)` to features `(N, dim)`."""
        x = self._map(frames).flatten(1)
        x = x if self.hidden is None else self.hidden(x).relu()
        return self.out(x)  # type: ignore[no-any-return]

    def patches(self, frames: Tensor) -> Tensor:
        """Frames `(N, 3, H, W)` to the cells of the last feature map, `(N, cells, channels)`."""
        return self._map(frames).flatten(2).transpose(1, 2)

    def _map(self, frames: Tensor) -> Tensor:
        stages: Any = self.stages
        for stage in stages:
            frames = stage.norm(stage.conv(frames)).relu()
        return frames


class Keypoints(nn.Module):
    """Fixed random filters, their expected positions (Finn et al., 2016), moments of colours, and linear layers.

    Args:
        image: Side of the images in pixels.
        filters: The `kernel`, `stride` and `channels` of each size of filters, which are not trained.
        sharpness: The factor of the responses, in standard deviations over an image, before the softmax.
        hidden: Features of each hidden layer.
        dim: Features of an image.
        seed: The seed of the filters, which the engine draws.
        colours: Red, green and blue of the colours whose pixels are located, in the units of the normalised images.
        find_colours: How many colours the engine finds in the training data before it makes a checkpoint.
    """

    takes_frames = True
    colours: Tensor

    def __init__(
        self,
        image: int,
        filters: Sequence[Mapping[str, int]],
        sharpness: float,
        hidden: Sequence[int],
        dim: int,
        seed: int = 0,
        colours: Sequence[Sequence[float]] = (),
        find_colours: int = 0,
    ) -> None:
        super().__init__()
        if find_colours and not colours:
            raise ValueError("encoder: its colours are not found yet; train with the engine or give `colours`")
        self.seed = seed
        self.register_buffer("colours", torch.tensor(colours, dtype=torch.float32).reshape(-1, 3), persistent=False)
        self.sharpness, self.filters, self.strides, features = sharpness, nn.ModuleList(), [], 0
        for sizes in filters:
            bank = nn.Conv2d(3, sizes["channels"], sizes["kernel"], bias=False)
            self.filters.append(bank.requires_grad_(False))
            self.strides.append(sizes["stride"])
            features += 3 * sizes["channels"]
        features += 10 * len(colours)
        self.norm = nn.BatchNorm1d(features)
        inputs = [features, *hidden]
        self.hidden = nn.ModuleList(nn.Linear(size, to) for size, to in zip(inputs, hidden, strict=False))
        self.out = nn.Linear(inputs[-1], dim)

    def forward(self, frames: Tensor) -> Tensor:
        """Frames `(N, 3, H, W)` to features `(N, dim)`."""
        banks = zip(self.filters, self.strides, strict=True)
        features = [self._keypoints(frames, bank, stride) for bank, stride in banks]
        if len(self.colours):
            features.append(self._moments(frames))
        x = self.norm(torch.cat(features, 1))
        for layer in self.hidden:
            x = nn.functional.gelu(layer(x))
        return self.out(x)  # type: ignore[no-any-return]

    def patches(self, frames: Tensor) -> Tensor:
        """Frames `(N, 3, H, W)` to the features of the image as one patch, `(N, 1, dim)`."""
        return self(frames).unsqueeze(1)  # type: ignore[no-any-return]

    def _keypoints(self, frames: Tensor, bank: Any, stride: int) -> Tensor:
        """The expected x and y of each filter, from -1 to 1, and its largest response: `(N, 3 * channels)`."""
        margin = bank.kernel_size[0] // 2
        maps = nn.functional.conv2d(frames, bank.weight, stride=stride, padding=margin)
        side, maps = maps.shape[-1], maps.flatten(2)
        spread = maps.std(2, correction=0, keepdim=True) + 1e-4
        maps = (maps - maps.mean(2, keepdim=True)) / spread
        weights = (self.sharpness * maps).softmax(2).unflatten(2, (side, side))
        places = torch.linspace(-1, 1, side, device=maps.device, dtype=maps.dtype)
        x, y = (weights.sum(axis) @ places for axis in (2, 3))
        return torch.cat([x, y, maps.amax(2) / 4], 1)

    def _moments(self, frames: Tensor) -> Tensor:
        """The fraction, the mean x and y, and the central moments of the pixels of each colour: `(N, 10 * colours)`."""
        count, _, side, _ = frames.shape
        distances = (frames.flatten(2).unsqueeze(1) - self.colours[None, :, :, None]).square().sum(2)
        weights = (-100 * distances).softmax(1).unflatten(2, (side, side))
        coordinates = torch.linspace(-1, 1, side, device=frames.device, dtype=frames.dtype)
        mass = weights.sum((2, 3))
        total = mass + 0.1  # A colour without pixels has moments of 0.
        x, y = (weights.sum(axis) @ coordinates / total for axis in (2, 3))
        dx, dy = coordinates - x.unsqueeze(2), coordinates - y.unsqueeze(2)
        orders = [(2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]
        central = [torch.einsum("nkyx,nkx,nky->nk", weights, dx**i, dy**j) / total for i, j in orders]
        return torch.stack([mass / side**2, x, y, *central], 2).reshape(count, -1)


def encoder_of(config: Mapping[str, Any], image: int) -> nn.Module:
    """The encoder of a configuration of the engine: `vit`, `dinov2`, `pyramid`, `conv` or `keypoints`, with its settings."""
    ((kind, settings),) = config.items()
    kinds: dict[str, Any] = {
        "vit": ViT,
        "dinov2": Dinov2,
        "pyramid": Pyramid,
        "conv": Convolutions,
        "keypoints": Keypoints,
    }
    if kind not in kinds:
        raise ValueError(f"encoder: {kind!r} has no torch module; expected one of {', '.join(kinds)}")
    return kinds[kind](image, **settings)  # type: ignore[no-any-return]
