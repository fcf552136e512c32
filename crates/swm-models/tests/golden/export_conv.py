"""Writes conv-*.safetensors: inputs, weights, features and gradients of very small convolutional encoders.

Run with an interpreter that has torch and safetensors:

    python export_conv.py FOLDER

Each file has images (`i.pixels`), the features with running statistics (`o.eval`) and with the statistics of the batch
(`o.train`), the running statistics after the batch (`s.*`), and the gradients of the mean square of `o.train`.
"""

import json
import sys
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import nn


class Stage(nn.Module):
    """A convolution and its normalisation."""

    def __init__(self, inputs, outputs):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, stride=2, padding=1, bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x):
        return self.norm(self.conv(x)).relu()


class Encoder(nn.Module):
    """Convolutions, then one or two linear layers."""

    def __init__(self, image, channels, hidden, dim):
        super().__init__()
        self.stages = nn.Sequential(*map(Stage, [3, *channels], channels))
        for _ in channels:
            image = (image + 1) // 2
        features = image * image * channels[-1]
        if hidden:
            self.hidden = nn.Linear(features, hidden)
        self.out = nn.Linear(hidden or features, dim)

    def forward(self, x):
        x = self.stages(x).flatten(1)
        return self.out(self.hidden(x).relu() if hasattr(self, "hidden") else x)


def write(path, config, images):
    generator = torch.Generator().manual_seed(0)
    random = lambda *shape: torch.randn(shape, generator=generator)
    model = Encoder(**config)
    with torch.no_grad():
        for value in model.state_dict().values():
            if value.dtype == torch.float32:
                value.add_(0.2 * random(*value.shape).abs())
    tensors = {f"w.{name}": value.clone() for name, value in model.state_dict().items()}
    pixels = random(images, 3, config["image"], config["image"])
    with torch.no_grad():
        evaluated = model.eval()(pixels)
    trained = model.train()(pixels)
    trained.square().mean().backward()
    tensors |= {"i.pixels": pixels, "o.eval": evaluated, "o.train": trained}
    tensors |= {f"s.{name}": value for name, value in model.named_buffers()}
    tensors |= {f"g.{name}": value.grad for name, value in model.named_parameters()}
    tensors = {name: value.detach().contiguous() for name, value in tensors.items() if value.dtype == torch.float32}
    save_file(tensors, path, metadata={"config": json.dumps(config | dict(patch=1))})


def main(folder):
    torch.manual_seed(0)
    write(folder / "conv-plain.safetensors", dict(image=16, channels=[4, 8, 6], hidden=0, dim=5), 6)
    write(folder / "conv-hidden.safetensors", dict(image=13, channels=[3, 17], hidden=7, dim=4), 5)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
