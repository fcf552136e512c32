"""Writes JPEG images with Pillow, and the pixels that Pillow decodes from each image as a PNG image beside it.

Run with Pillow and numpy: `python jpeg_export.py`. Pillow decodes with libjpeg-turbo's defaults, as OpenCV and
torchvision do.
"""

from pathlib import Path

import numpy as np
from PIL import Image

HERE = Path(__file__).parent / "jpeg"


def gradient(height, width):
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 3, y * 3, x + y], -1).clip(0, 255).astype(np.uint8)


def disc(height, width):
    y, x = np.mgrid[:height, :width]
    image = np.full((height, width, 3), (250, 240, 230), np.uint8)
    image[(y - 30) ** 2 + (x - 40) ** 2 < 300] = (30, 60, 250)
    image[height // 2 :, : width // 3] = (144, 238, 144)
    return image


def noise(height, width):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def save(name, image, mode="RGB", **options):
    path = HERE / f"{name}.jpg"
    Image.fromarray(image).convert(mode).save(path, **options)
    Image.open(path).convert("RGB").save(path.with_suffix(".png"), optimize=True)


HERE.mkdir(exist_ok=True)
save("halved-disc", disc(96, 112), quality=95)
save("halved-disc-odd", disc(61, 83), quality=75, optimize=True)
save("halved-gradient", gradient(65, 70), quality=30)
save("halved-noise", noise(33, 50), quality=95)
save("halved-narrow", gradient(40, 5), quality=95)
save("full-disc", disc(61, 83), quality=90, subsampling=0)
save("full-noise", noise(20, 27), quality=100, subsampling=0)
# Files of kinds that the fast decoder leaves to the general decoder.
save("other-progressive", disc(61, 83), quality=90, progressive=True)
save("other-columns", disc(61, 83), quality=90, subsampling=1)
save("other-grey", disc(61, 83), mode="L", quality=90)
save("other-restarts", disc(61, 83), quality=90, restart_marker_rows=1)
