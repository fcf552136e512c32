"""Checkpoints of the engine as torch modules, whose outputs equal the engine's up to rounding."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from .. import _engine
from ._located import folder_of
from ._weights import load_into, read_capsule, read_safetensors
from .encoders import encoder_of
from .frames import Frames
from .gcrl import GCRL
from .gcrl.module import MetricValuePredictor, QPredictor, WithTarget
from .gcrl.module import Predictor as Head
from .lewm import LeWM
from .lewm.module import MLP, Embedder, Predictor
from .pldm import PLDM
from .pldm.module import InverseDynamics
from .prejepa import PreJEPA
from .prejepa.module import CausalPredictor, PatchDecoder
from .prejepa.module import Embedder as ColumnEmbedder
from .pretrained import Pretrained, Stored
from .tdmpc2 import TDMPC2

__all__ = ["check_kind", "load", "module_of"]

Model = TypeVar("Model", bound=Pretrained)


def load(name: str | os.PathLike[str], kind: type[Model]) -> Model:
    """Loads a checkpoint as a module of the class `kind`, or of a class derived from the family's; see `Pretrained`."""
    path = Path(_engine.Model(str(name), "cpu", "null", False).path)
    found = module_of(path, kind)
    if not isinstance(found, kind):
        raise TypeError(f"{name}: it holds no {kind.__name__}; load it with swm.wm.load_pretrained")
    return found


def module_of(path: Path, kind: type[Pretrained] | None = None) -> Any:
    """The torch module of a run folder of `swm train` or of a capsule; `None` if there is none at the path.

    Args:
        path: The run, the folder `checkpoint` in it, or the capsule.
        kind: A class derived from the family's class; the family's class for `None`.

    Raises:
        TypeError: If the checkpoint holds a model of another class than `kind`.
        ValueError: If its family has no torch module.
    """
    parts = _parts(path)
    if parts is None:
        return None
    stored, weights = parts
    family = str(stored.file.get("family"))
    if family not in _FAMILIES:
        known = ", ".join(_FAMILIES)
        raise ValueError(f"{path}: the family {family!r} has no torch module ({known} have one); plan with swm.wm.load")
    known_kind, build = _FAMILIES[family]
    kind = known_kind if kind is None else kind
    if not issubclass(kind, known_kind) and not issubclass(known_kind, kind):
        raise TypeError(f"{path}: it holds a model of the family {family!r}, a {known_kind.__name__}, not a {kind.__name__}")
    kind = kind if issubclass(kind, known_kind) else known_kind
    model = build(kind, stored, weights)
    model.stored, model.action_block = stored, int(stored.config["data"]["frameskip"])
    renamed = {model._checkpoint_name(name): name for name in model.state_dict()}
    load_into(model, {renamed.get(name, name): value for name, value in weights.items()}, "the checkpoint")
    return model.eval()


def check_kind(family: str, kind: type[Pretrained] | None) -> None:
    """Checks that a model of a family can have a class, before there is a checkpoint; see `module_of`.

    Raises:
        TypeError: If the class is neither derived from that of the family nor a base of it.
    """
    known = _FAMILIES[family][0]
    if kind is not None and not issubclass(kind, known) and not issubclass(known, kind):
        name = known.__name__
        raise TypeError(f"a model of the family {family!r} is a {name}, not a {kind.__name__}; derive the class from {name}")


def _parts(path: Path) -> tuple[Stored, dict[str, Tensor]] | None:
    """The parts of a checkpoint; `None` if there is none at the path."""
    if path.is_file():
        if path.suffix != ".safetensors":
            return None
        document, weights = read_capsule(path)
        return Stored(document["checkpoint"], document["manifest"]), weights
    folder = folder_of(path)
    if folder is None:
        return None
    manifest = folder / "manifest.json"
    provenance = json.loads(manifest.read_text(encoding="utf-8")) if manifest.is_file() else {}
    return Stored(json.loads((folder / "config.json").read_text(encoding="utf-8")), provenance), read_safetensors(
        folder / "weights.safetensors"
    )


def _jepa(kind: Callable[..., Any], stored: Stored, weights: Mapping[str, Tensor]) -> Any:
    model = stored.config["model"]
    latent, sizes = model["latent"], model["predictor"]
    actions = _action_size(stored)
    (settings,) = model["encoder"].values()
    made = kind(
        encoder_of(model["encoder"], model["image"]),
        Predictor(
            num_frames=sizes["history"],
            depth=sizes["depth"],
            heads=sizes["heads"],
            mlp_dim=sizes["mlp"],
            input_dim=latent,
            hidden_dim=sizes["dim"],
            output_dim=latent,
            dim_head=sizes["dim_head"],
            dropout=sizes.get("dropout", 0.0),
            emb_dropout=sizes.get("emb_dropout", 0.0),
        ),
        Embedder(actions, model.get("smoothed") or actions, latent),
        _projector(settings["dim"], model["projector"], latent),
        _projector(latent, model["projector"], latent),
    )
    made.frames = _frames(model)
    if model.get("decoder"):
        made.decoder = _decoder(latent, model["decoder"]["hidden"], made.encoder)
    if any(name.startswith("idm.") for name in weights):
        made.idm = InverseDynamics(latent, stored.config["loss"]["idm_hidden"], actions)
    return made


def _decoder(latent: int, hidden: int, encoder: Any) -> nn.Module:
    """The decoder of latents to the features of fixed filters, which is part of the loss of `swm train` only."""
    layers = [nn.Linear(latent, hidden), nn.GELU(), nn.Linear(hidden, hidden), nn.GELU()]
    return nn.ModuleDict({"net": nn.Sequential(*layers, nn.Linear(hidden, encoder.norm.num_features))})


def _projector(inputs: int, hidden: int, outputs: int) -> MLP:
    return MLP(inputs, hidden, outputs, norm_fn=nn.BatchNorm1d)


def _frames(model: Mapping[str, Any]) -> Frames:
    return Frames(model["pixel_mean"], model["pixel_std"])


def _action_size(stored: Stored) -> int:
    """Elements of the actions of a model step."""
    return int(stored.config["data"]["frameskip"]) * len(stored.file["facts"]["action"]["mean"])


def _patches(encoder: nn.Module, image: int) -> tuple[int, int]:
    """The number of patches of an image, and the features of a patch."""
    training = encoder.training
    with torch.no_grad():
        shape = encoder.eval().patches(torch.zeros(1, 3, image, image)).shape  # type: ignore[operator]
    encoder.train(training)
    return int(shape[1]), int(shape[2])


def _dinowm(kind: Callable[..., Any], stored: Stored, weights: Mapping[str, Tensor]) -> Any:
    model, columns = stored.config["model"], stored.file["facts"]["columns"]
    encoder, sizes = encoder_of(model["encoder"], model["image"]), model["predictor"]
    patches, features = _patches(encoder, model["image"])
    names = {column["name"]: column["dim"] for column in model["columns"]}
    elements = {name: _action_size(stored) if name == "action" else len(columns[name]["mean"]) for name in names}
    extra = {name: ColumnEmbedder(in_chans=elements[name], emb_dim=dim) for name, dim in names.items()}
    made = kind(
        encoder.requires_grad_(False),
        CausalPredictor(
            num_patches=patches,
            num_frames=sizes["history"],
            dim=features + sum(names.values()),
            depth=sizes["depth"],
            heads=sizes["heads"],
            mlp_dim=sizes["mlp"],
            dim_head=sizes["dim_head"],
            dropout=sizes["dropout"],
            emb_dropout=sizes["emb_dropout"],
        ),
        nn.ModuleDict(extra),
        PatchDecoder(features, model["decoder"], _patch_side(model)) if model["decoder"] else None,
        history_size=sizes["history"],
    )
    made.frames = _frames(model)
    made.scales = {name: _scale(columns[name]) for name in names if name != "action"}
    return made


def _patch_side(model: Mapping[str, Any]) -> int:
    (settings,) = model["encoder"].values()
    return int(settings["patch"])


def _scale(column: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of a column; constant elements are not scaled."""
    std = torch.tensor(column["std"], dtype=torch.float64)
    return torch.tensor(column["mean"], dtype=torch.float64), torch.where(std > 1e-6, std, 1.0)


def _gcrl(kind: Callable[..., Any], stored: Stored, weights: Mapping[str, Tensor]) -> Any:
    model, family = stored.config["model"], stored.file["family"]
    encoder, sizes = encoder_of(model["encoder"], model["image"]), model["head"]
    patches, features = _patches(encoder, model["image"])
    actions = _action_size(stored)
    common = {
        "num_patches": patches,
        "num_frames": model["history"],
        "dim": features,
        "depth": sizes["depth"],
        "heads": sizes["heads"],
        "mlp_dim": sizes["mlp"],
        "dim_head": sizes["dim_head"],
        "dropout": sizes["dropout"],
        "emb_dropout": sizes["emb_dropout"],
    }
    value: Any = None
    if model.get("metric", 0) > 0:
        value = WithTarget(MetricValuePredictor, embed_dim=model["metric"], **common)
        # It is part of published weights, and not used.
        value.student.pos_embedding_goal.requires_grad_(False)
    elif family != "gcbc":
        value = WithTarget(Head, out_dim=1, pool_type="mean", **common)
    critic = {"action_dim": actions, "q_hidden_dim": model.get("critic", 256), "pool_type": "mean"}
    made = kind(
        encoder.requires_grad_(not model["frozen"]),
        Head(out_dim=actions, **common),
        value,
        WithTarget(QPredictor, **critic, **common) if family == "gciql" else None,
        history_size=model["history"],
    )
    made.log_stds.requires_grad_(family != "gcbc")
    made.frames = _frames(model)
    return made


def _tdmpc2(kind: Callable[..., Any], stored: Stored, weights: Mapping[str, Tensor]) -> Any:
    model, loss, columns = stored.config["model"], stored.config["loss"], stored.file["facts"]["columns"]
    encoding = {entry["column"]: entry["latent"] for entry in model["encoding"]}
    wm = {
        "encoding": encoding,
        "enc_dim": model["encoder"],
        "mlp_dim": model["hidden"],
        "num_q": model["critics"],
        "num_bins": model["bins"]["count"],
        "vmin": model["bins"]["low"],
        "vmax": model["bins"]["high"],
        "simnorm_dim": model["simplex"],
        "dropout": model["dropout"],
        "termination": model["termination"],
        "horizon": stored.config["data"]["num_steps"] - 1,
        "uncertainty_penalty": loss["uncertainty"],
        **{f"{name}_coef": loss[name] for name in ("consistency", "reward", "value", "entropy")},
        **{name: loss[name] for name in ("discount", "rho", "tau")},
    }
    extra_dims = {name: len(columns[name]["mean"]) for name in encoding if name != "pixels"}
    return kind({"action_dim": _action_size(stored), "image_size": model["image"], "extra_dims": extra_dims, "wm": wm})


#: The class of each family, and the function that builds a module of a class derived from it.
_FAMILIES: Mapping[str, tuple[type[Pretrained], Callable[..., Any]]] = {
    "lewm": (LeWM, _jepa),
    "pldm": (PLDM, _jepa),
    "dino_wm": (PreJEPA, _dinowm),
    "tdmpc2": (TDMPC2, _tdmpc2),
    "gcbc": (GCRL, _gcrl),
    "gcivl": (GCRL, _gcrl),
    "gciql": (GCRL, _gcrl),
}
