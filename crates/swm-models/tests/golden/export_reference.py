"""Writes checkpoints of the reference to reference/{lewm,pldm,prejepa}, and recorded inputs and outputs to
reference-*.safetensors.

Run with an interpreter that has the reference package, stable-pretraining, hydra, torch and transformers:

    python export_reference.py FOLDER/reference

Hydra builds each model from the configuration that is stored as `config.json`; the reference's `save_pretrained` saves
the model. The state dict of `lewm` has the names of transformers 5, the state dict of `pldm` the names of version 4 and
of published files, and the state dict of `prejepa` the prefix of a wrapped encoder.
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path

import torch
from export_vit import published
from hydra.utils import instantiate
from omegaconf import OmegaConf
from safetensors.torch import save_file
from stable_pretraining.backbone import EvalOnly
from stable_worldmodel.wm.utils import save_pretrained
from transformers import Dinov2Config, Dinov2Model


def world_model(family, cls):
    module = f"stable_worldmodel.wm.{family}.module"
    norm = dict(_target_="torch.nn.BatchNorm1d", _partial_=True)
    project = lambda inputs: dict(
        _target_=f"{module}.MLP", input_dim=inputs, output_dim=6, hidden_dim=16, norm_fn=norm
    )
    return dict(
        _target_=cls,
        encoder=dict(
            _target_="stable_pretraining.backbone.utils.vit_hf", size="tiny", patch_size=4, image_size=8,
            pretrained=False, use_mask_token=family == "lewm", hidden_size=12, num_hidden_layers=2,
            num_attention_heads=2, intermediate_size=16,
        ),
        predictor=dict(
            _target_=f"{module}.Predictor", num_frames=3, input_dim=6, hidden_dim=12, output_dim=6, depth=2, heads=2,
            mlp_dim=16, dim_head=4, dropout=0.1, emb_dropout=0.0,
        ),
        action_encoder=dict(_target_=f"{module}.Embedder", input_dim=4, emb_dim=6),
        projector=project(12),
        pred_proj=project(6),
    )  # fmt: skip


def prejepa():
    module = "stable_worldmodel.wm.prejepa.module"
    embedder = lambda elements, dim: dict(_target_=f"{module}.Embedder", in_chans=elements, emb_dim=dim)
    return dict(
        _target_="stable_worldmodel.wm.PreJEPA", history_size=2, num_pred=1, interpolate_pos_encoding=False,
        encoder=dict(_target_=f"{module}.create_backbone", name="dinov2_small"),
        predictor=dict(
            _target_=f"{module}.CausalPredictor", num_patches=4, num_frames=2, dim=70, depth=1, heads=2, mlp_dim=16,
            dim_head=8, dropout=0.1, emb_dropout=0.0,
        ),
        extra_encoders=dict(_target_="torch.nn.ModuleDict", modules=dict(proprio=embedder(3, 2), action=embedder(4, 4))),
    )  # fmt: skip


def perturb(model):
    with torch.no_grad():
        for name, value in model.state_dict().items():
            if name.endswith("running_var"):
                value.copy_(torch.rand_like(value) + 0.5)
            elif value.is_floating_point() and value.dim() < 4:
                value.add_(0.1 * torch.randn_like(value))
    model.eval()


def save(model, config, folder, rename=None):
    with tempfile.TemporaryDirectory() as cache:
        save_pretrained(model, "run", config=OmegaConf.create(config), cache_dir=cache)
        folder.mkdir(parents=True, exist_ok=True)
        for file in (Path(cache) / "checkpoints" / "run").iterdir():
            shutil.copy(file, folder / file.name)
    if rename:
        weights = torch.load(folder / "weights.pt")
        torch.save({rename(name): value for name, value in weights.items()}, folder / "weights.pt")


def tensors(path, all):
    all = {name: value.detach().float().contiguous().clone() for name, value in all.items()}
    save_file(all, path, metadata={"config": json.dumps(dict(image=8, patch=4))})


@torch.no_grad()
def main(folder):
    torch.manual_seed(0)
    for family, cls in [("lewm", "stable_worldmodel.wm.lewm.LeWM"), ("pldm", "stable_worldmodel.wm.pldm.pldm.PLDM")]:
        config = world_model(family, cls)
        model = instantiate(config)
        perturb(model)
        rename = lambda name: (
            "encoder." + published(name.removeprefix("encoder."), dino=False) if name.startswith("encoder.") else name
        )
        save(model, config, folder / family, rename if family == "pldm" else None)
        pixels, action = torch.randn(2, 3, 3, 8, 8), torch.randn(2, 3, 4)
        info = model.encode(dict(pixels=pixels, action=action))
        predicted = model.predict(info["emb"], info["act_emb"])
        all = {"i.pixels": pixels, "i.action": action, "o.emb": info["emb"], "o.pred": predicted}
        tensors(folder.parent / f"reference-{family}.safetensors", all)

    config = prejepa()
    encoder = Dinov2Config(
        hidden_size=64, num_hidden_layers=1, num_attention_heads=1, mlp_ratio=1, patch_size=4, image_size=12
    )
    model = instantiate(config, encoder=EvalOnly(Dinov2Model(encoder)))
    perturb(model)
    save(model, config, folder / "prejepa")
    pixels = torch.randn(2, 2, 3, 8, 8)
    columns = dict(proprio=torch.randn(2, 2, 3), action=torch.randn(2, 2, 4))
    info = model.encode(dict(pixels=pixels, **columns))
    all = {"i.pixels": pixels, "o.emb": info["emb"], "o.pred": model.predict(info["emb"])}
    tensors(folder.parent / "reference-prejepa.safetensors", all | {f"i.{name}": value for name, value in columns.items()})


main(Path(sys.argv[1]))
