"""Checkpoints of the engine as torch modules, whose outputs equal the engine's up to rounding."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from torch import nn

from ._weights import load_into, read_safetensors
from .encoders import encoder_of
from .frames import Frames
from .lewm import LeWM
from .lewm.module import MLP, Embedder, Predictor
from .pldm import PLDM

__all__ = ["module_of"]


def module_of(path: Path) -> Any:
    """The torch module of a run folder of `swm train`; `None` if there is none at the path."""
    folder = next((f for f in (path, path / "checkpoint") if (f / "weights.safetensors").is_file()), None)
    if folder is None:
        return None
    config = json.loads((folder / "config.json").read_text())
    family = config.get("family")
    if family not in _FAMILIES:
        known = ", ".join(_FAMILIES)
        raise ValueError(f"{path}: the family {family!r} has no torch module ({known} have one); plan with swm.wm.load")
    weights = read_safetensors(folder / "weights.safetensors")
    model = _FAMILIES[family](config, weights)
    return model.eval()


def _jepa(kind: type[LeWM] | type[PLDM]) -> Callable[[dict[str, Any], dict[str, Any]], nn.Module]:
    def made(file: dict[str, Any], weights: dict[str, Any]) -> nn.Module:
        model, data = file["config"]["model"], file["config"]["data"]
        # A PLDM is stored together with its inverse dynamics, which planning does not need.
        weights = {
            name.removeprefix("model."): value for name, value in weights.items() if not name.startswith(("idm.", "inverse"))
        }
        latent, sizes = model["latent"], model["predictor"]
        smoothed, actions = weights["action_encoder.patch_embed.weight"].shape[:2]
        encoder = encoder_of(model["encoder"], model["image"])
        (settings,) = model["encoder"].values()
        made = kind(
            encoder,
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
            Embedder(actions, smoothed, latent),
            _projector(settings["dim"], model["projector"], latent),
            _projector(latent, model["projector"], latent),
        )
        made.frames = Frames(model["pixel_mean"], model["pixel_std"])
        made.action_block = int(data["frameskip"])
        load_into(made, weights, "the checkpoint")
        return made

    return made


def _projector(inputs: int, hidden: int, outputs: int) -> MLP:
    return MLP(inputs, hidden, outputs, norm_fn=nn.BatchNorm1d)


#: The functions that build a module of the content of `config.json` and the weights, by family.
_FAMILIES: Mapping[str, Callable[[dict[str, Any], dict[str, Any]], nn.Module]] = {"lewm": _jepa(LeWM), "pldm": _jepa(PLDM)}
