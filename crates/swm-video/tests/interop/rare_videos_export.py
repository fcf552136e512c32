"""Writes videos of rare encodings as `rare-NAME.mp4`, and the frames that FFmpeg decodes from them, one below the other, as
`rare-NAME.png`. The tests of `swm-video/src/rare_tests.rs` compare their decoded frames with these images.

python rare_videos_export.py    (ffmpeg 5 or later with libx264 and libx265; numpy, Pillow)
"""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

here = Path(__file__).parent
SIZE = ["-f", "lavfi", "-i", "testsrc2=size=64x48:rate=25:duration=0.8"]


def ffmpeg(*words):
    return subprocess.run(["ffmpeg", "-v", "error", "-y", *map(str, words)], check=True, capture_output=True).stdout


def frames(name):
    raw = ffmpeg("-i", here / f"rare-{name}.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-")
    Image.fromarray(np.frombuffer(raw, np.uint8).reshape(-1, 64, 3)).save(here / f"rare-{name}.png")


def encode(path, codec, pixels, options):
    ffmpeg(*SIZE, "-c:v", codec, "-pix_fmt", pixels, f"-{codec[3:]}-params", options, path)


# 10 bits of colours and of grey, whose values have the full range.
encode(here / "rare-rgb.mp4", "libx265", "gbrp10le", "log-level=none")
encode(here / "rare-grey.mp4", "libx265", "gray10le", "log-level=none")
# Key frames of open groups, from which later frames cannot be decoded.
encode(here / "rare-open.mp4", "libx264", "yuv420p", "open-gop=1:keyint=8:min-keyint=4:bframes=3:b-pyramid=normal")
# One file, and the join of it and another one, whose parameters then stand among the frames.
encode(here / "rare-first.mp4", "libx264", "yuv420p", "qp=20:cabac=0")
with tempfile.TemporaryDirectory() as folder:
    second, listed = Path(folder, "second.mp4"), Path(folder, "list.txt")
    encode(second, "libx264", "yuv420p", "qp=38:cabac=0")
    listed.write_text(f"file {here / 'rare-first.mp4'}\nfile {second}\n")
    ffmpeg("-f", "concat", "-safe", "0", "-i", listed, "-c", "copy", here / "rare-joined.mp4")
# Colours that only a box of the file states, and greys whose range nothing states.
with tempfile.TemporaryDirectory() as folder:
    plain = Path(folder, "plain.mp4")
    encode(plain, "libx264", "yuv444p", "qp=10")
    ffmpeg("-i", plain, "-c", "copy", "-color_range", "pc", "-colorspace", "bt709", "-movflags", "write_colr", here / "rare-box.mp4")
ffv1 = ["-c:v", "ffv1", "-level", "3", "-g", "1", "-pix_fmt", "gray", "-f", "mov"]
ffmpeg(*SIZE[:3], "testsrc2=size=64x48:rate=25:duration=0.2", *ffv1, here / "rare-ffv1.mp4")
for name in ("rgb", "grey", "open", "first", "joined", "box", "ffv1"):
    frames(name)
