"""The image encoders of DINO-WM with the architectures of `transformers`, with random weights in small sizes: no downloads."""

import pytest

transformers = pytest.importorskip("transformers")
torch = pytest.importorskip("torch")

from stable_worldmodel.wm.patches import PatchEncoder  # noqa: E402
from stable_worldmodel.wm.prejepa.module import BACKBONES, create_backbone  # noqa: E402

SIDE, PATCH = 32, 8
VIT = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 64}
IMAGE = {"image_size": SIDE, "patch_size": PATCH}
DINO = {"hidden_size": 32, "num_hidden_layers": 2, "num_attention_heads": 2, "mlp_ratio": 2}
VIDEO = {"crop_size": SIDE, "patch_size": PATCH, "frames_per_clip": 4, "pred_hidden_size": 16}

#: The configuration of each family, by the beginning of the names of its backbones.
FAMILIES = {
    "dino_": lambda: transformers.ViTConfig(**IMAGE, **VIT),
    "dinov2_": lambda: transformers.Dinov2Config(**IMAGE, **DINO),
    "dinov3_": lambda: transformers.DINOv3ViTConfig(**IMAGE, **VIT, num_register_tokens=4),
    "ijepa_": lambda: transformers.IJepaConfig(**IMAGE, **VIT),
    "mae_": lambda: transformers.ViTMAEConfig(**IMAGE, **VIT),
    "resnet_": lambda: transformers.ResNetConfig(embedding_size=8, hidden_sizes=[8, 16], depths=[1, 1]),
    "siglip2_": lambda: transformers.SiglipConfig(text_config={**VIT, "vocab_size": 50}, vision_config={**IMAGE, **VIT}),
    "vit_": lambda: transformers.ViTConfig(**IMAGE, **VIT),
    "vjepa2_": lambda: transformers.VJEPA2Config(
        **VIDEO, **DINO, pred_num_hidden_layers=1, pred_num_attention_heads=2, pred_mlp_ratio=2
    ),
    "webssl_": lambda: transformers.Dinov2Config(**IMAGE, **DINO),
}


class Patches(PatchEncoder):
    """The patches of a backbone."""

    def __init__(self, backbone, interpolate):
        super().__init__(None, interpolate)
        self.encoder = backbone

    def _image_encoder(self):
        return self.encoder

    def of(self, frames, is_video=False):
        with torch.inference_mode():
            return self._embedded({"pixels": frames.clone()}, "pixels", None, None, "embed", is_video)["embed"]


@pytest.fixture
def offline(monkeypatch):
    """`from_pretrained` gives a network of the family's architecture with random weights, and records its name."""
    asked = []

    def instead_of(cls):
        def make(name):
            asked.append(name)
            key = next(key for key, known in BACKBONES.items() if known == name)
            return cls.from_config(next(make() for family, make in FAMILIES.items() if key.startswith(family)))

        return make

    for cls in (transformers.AutoModel, transformers.AutoModelForImageClassification):
        monkeypatch.setattr(cls, "from_pretrained", instead_of(cls))
    torch.manual_seed(0)
    return asked


def test_every_backbone_belongs_to_a_family():
    assert all(any(key.startswith(family) for family in FAMILIES) for key in BACKBONES)


@pytest.mark.parametrize("interpolate", [True, False])
@pytest.mark.parametrize("name", ["dino_vits16", "dinov2_small", "dinov3_small", "ijepa_huge", "mae_base", "siglip2_base_224",
                                  "vit_base_patch16", "webssl_large"])  # fmt: skip
def test_image_encoders_give_all_patches_of_each_frame(offline, name, interpolate):
    encoder = Patches(create_backbone(name).eval(), interpolate)
    assert offline == [BACKBONES[name]]
    frames = torch.rand(2, 3, 3, SIDE, SIDE)
    patches = encoder.of(frames)
    # Neither tokens of the whole image and registers, nor fewer than all patches.
    assert patches.shape == (2, 3, (SIDE // PATCH) ** 2, 32)
    assert torch.equal(encoder.of(frames), patches), "an encoding is deterministic"
    # Each frame is encoded on its own, and a change of one corner changes that patch the most.
    assert torch.allclose(encoder.of(frames[:, 1:2]), patches[:, 1:2], atol=1e-5)
    changed = frames.clone()
    changed[..., -PATCH:, -PATCH:] = 0
    difference = (encoder.of(changed) - patches).norm(dim=-1)
    assert (difference.argmax(-1) == patches.shape[2] - 1).all()


def test_a_resnet_gives_one_feature_vector(offline):
    encoder = Patches(create_backbone("resnet_50").eval(), True)
    features = encoder.of(torch.rand(2, 3, 3, SIDE, SIDE))
    assert features.shape == (2, 3, 1, 16) and features.mean(-1).abs().max() < 1e-5, "normalised, without a classifier"


def test_a_video_encoder_sees_the_frames_so_far(offline):
    encoder = Patches(create_backbone("vjepa2_large").eval(), True)
    frames = torch.rand(1, 4, 3, SIDE, SIDE)
    patches = encoder.of(frames, is_video=True)
    assert patches.shape[:2] == (1, 4) and patches.shape[2] % (SIDE // PATCH) ** 2 == 0
    later = frames.clone()
    later[:, 3] = 0
    after = encoder.of(later, is_video=True)
    assert torch.equal(after[:, :3], patches[:, :3]) and not torch.allclose(after[:, 3], patches[:, 3])
