"""Modules from a configuration: a tree of `_target_` and arguments, as Hydra instantiates it.

Only the modules of this package and layers of torch are built. Another target runs code that the file names, so it needs
the user's consent.
"""

from __future__ import annotations

import functools
import importlib
import re
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import nn

from .encoders import ViT

__all__ = ["build"]

#: The package whose classes may be built, and the layers of torch.
_OWN = "stable_worldmodel.wm."
_LAYERS = (
    "BatchNorm1d",
    "BatchNorm2d",
    "Conv1d",
    "Conv2d",
    "Dropout",
    "ELU",
    "Flatten",
    "GELU",
    "Identity",
    "LayerNorm",
    "LeakyReLU",
    "Linear",
    "Mish",
    "ModuleDict",
    "ModuleList",
    "ReLU",
    "Sequential",
    "SiLU",
    "Sigmoid",
    "Softmax",
    "Softplus",
    "Tanh",
)


def build(config: Any, trust: bool = False) -> Any:
    """The object that a configuration describes.

    Args:
        config: A mapping with `_target_` and arguments, a list, or a plain value.
        trust: Whether other targets than this package's modules and torch's layers may be imported and called.
    """
    if isinstance(config, Mapping):
        given = {key: build(value, trust) for key, value in config.items() if key not in ("_target_", "_partial_", "_args_")}
        positional = [build(value, trust) for value in config.get("_args_", ())]
        if "_target_" not in config:
            return given
        target = _target(str(config["_target_"]), trust)
        if config.get("_partial_"):
            return functools.partial(target, *positional, **given)
        return target(*positional, **given)
    if isinstance(config, (list, tuple)):
        return [build(value, trust) for value in config]
    return config


def _target(path: str, trust: bool) -> Callable[..., Any]:
    package, _, name = path.rpartition(".")
    if path == "stable_pretraining.backbone.utils.vit_hf":
        return _vit
    layer = package in ("torch.nn", "torch.nn.modules") and name in _LAYERS
    if layer or trust:
        found = getattr(importlib.import_module(package), name, None)
        if not callable(found):
            raise ValueError(f"_target_: there is no {path!r}")
        return found  # type: ignore[no-any-return]
    if path == "stable_worldmodel.wm.prejepa.module.create_backbone":
        return _known_backbone
    if path.startswith(_OWN) and not any(part.startswith("_") for part in path.split(".")):
        try:
            found = getattr(importlib.import_module(package), name, None)
        except ModuleNotFoundError as error:
            raise ValueError(f"_target_: there is no {path!r}") from error
        # Only models that are written here: a function of this package might write files, and a class that loads another
        # library's models would pass the arguments on, which may name files and hosts.
        if isinstance(found, type) and issubclass(found, nn.Module) and found.__module__.startswith(_OWN):
            return _timm_encoder if found.__name__ == "TimmEncoder" else found
    raise ValueError(
        f"_target_: {path!r} is neither a model of this package nor a layer of torch, and calling it runs code that the file "
        "names; pass trust=True if you trust the file"
    )


def _known_backbone(name: str) -> nn.Module:
    """A pretrained encoder that a file names: one of the known ones."""
    from .prejepa.module import BACKBONES, create_backbone

    if name not in BACKBONES:
        raise ValueError(f"create_backbone: {name!r} is none of {', '.join(BACKBONES)}; pass trust=True if you trust the file")
    with torch.device("cpu"):
        return create_backbone(name)


def _timm_encoder(name: str, **settings: Any) -> nn.Module:
    """An encoder of `timm` that a file names, without weights: the file of the weights has them."""
    from .prejepa.module import TimmEncoder

    known = {"pretrained", "num_classes", "img_size", "patch_size"}
    others = sorted(set(settings) - known)
    # A name with a prefix, such as `hf-hub:`, is a place to load from.
    if not re.fullmatch(r"[A-Za-z0-9_.]{1,100}", str(name)) or others:
        given = f"the name {name!r}" if not others else f"the settings {', '.join(others)}"
        raise ValueError(f"TimmEncoder: {given} may name a file or a host; pass trust=True if you trust the file")
    sizes = {key: int(value) for key, value in settings.items() if key != "pretrained"}
    return TimmEncoder(str(name), **{**sizes, "pretrained": False})


#: Sizes of vision transformers: features, layers, heads, hidden features of a layer.
_SIZES = {
    "tiny": (192, 12, 3, 768),
    "small": (384, 12, 6, 1536),
    "base": (768, 12, 12, 3072),
    "large": (1024, 24, 16, 4096),
}


def _vit(
    size: str = "tiny",
    patch_size: int = 16,
    image_size: int = 224,
    pretrained: bool = False,
    use_mask_token: bool = True,
    **settings: Any,
) -> ViT:
    """A vision transformer of a configuration, with random weights."""
    if size not in _SIZES:
        raise ValueError(f"size: {size!r}; expected one of {', '.join(_SIZES)}")
    dim, depth, heads, mlp = _SIZES[size]
    return ViT(
        image_size,
        patch_size,
        int(settings.get("hidden_size", dim)),
        int(settings.get("num_hidden_layers", depth)),
        int(settings.get("num_attention_heads", heads)),
        int(settings.get("intermediate_size", mlp)),
        mask_token=use_mask_token,
    )
