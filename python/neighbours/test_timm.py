"""The image encoders of DINO-WM with the architectures of `timm`, with random weights in small sizes: no downloads."""

import pytest

timm = pytest.importorskip("timm")
torch = pytest.importorskip("torch")

from stable_worldmodel.wm import PreJEPA  # noqa: E402
from stable_worldmodel.wm.prejepa.module import CausalPredictor, Embedder, create_backbone  # noqa: E402

SMALL = {"embed_dim": 32, "depth": 2, "num_heads": 2}


@pytest.fixture
def offline(monkeypatch):
    """`create_model` gives random weights, and records what was asked for."""
    asked, create = [], timm.create_model

    def make(name, pretrained, **settings):
        asked.append((name, pretrained, settings))
        return create(name, pretrained=False, **settings, **(SMALL if name.startswith("vit_") else {}))

    monkeypatch.setattr(timm, "create_model", make)
    torch.manual_seed(0)
    return asked


@pytest.mark.parametrize(
    ("name", "side", "patches", "dim"),
    [
        ("vit_small_patch16_224.augreg_in1k", 64, 16, 32),
        # Registers are no patches.
        ("vit_small_patch14_reg4_dinov2.lvd142m", 56, 16, 32),
        ("test_resnet.r160_in1k", 64, 4, 96),
        ("test_convnext.r160_in1k", 64, 4, 64),
    ],
)
def test_encoders_give_the_places_of_a_frame(offline, name, side, patches, dim):
    encoder = create_backbone(f"timm/{name}").eval()
    assert offline[0] == (name, True, {"dynamic_img_size": True, "num_classes": 0})
    images = torch.rand(2, 3, side, side)
    with torch.inference_mode():
        found = encoder(images)
        assert found.shape == (2, patches, dim) and torch.equal(encoder.patches(images), found)
        changed = images.clone()
        changed[..., -side // 4 :, -side // 4 :] = 0
        difference = (encoder(changed) - found).norm(dim=-1)
    assert (difference.argmax(-1) == patches - 1).all(), "places are in the order of rows"


def test_a_world_model_plans_with_an_encoder_of_timm(offline):
    encoder = create_backbone("timm/vit_small_patch16_224.augreg_in1k").requires_grad_(False)
    sizes = {"num_patches": 16, "num_frames": 1, "dim": 32 + 4, "depth": 1, "heads": 2, "mlp_dim": 16, "dim_head": 8}
    extra = torch.nn.ModuleDict({"action": Embedder(in_chans=2, emb_dim=4)})
    model = PreJEPA(encoder, CausalPredictor(**sizes), extra, history_size=1).eval()
    frames = torch.randint(0, 256, (2, 3, 1, 3, 64, 64), dtype=torch.uint8)
    infos = {"pixels": frames[:, :1].expand_as(frames), "goal": frames[:, 1:2].expand_as(frames)}
    with torch.inference_mode():
        assert model.get_cost(infos, torch.randn(2, 3, 4, 2)).shape == (2, 3)
