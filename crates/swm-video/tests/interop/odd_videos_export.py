"""Writes videos with unusual timing, codecs or pixel formats as `odd-NAME.mp4`, and the frames that FFmpeg's library
decodes from them, one below the other, as `odd-NAME.png`. The tests of `swm-video/src/decode.rs` compare their decoded
frames with these images.

python odd_videos_export.py    (av 15)
"""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from PIL import Image

here = Path(__file__).parent


def image(t):
    y, x = np.mgrid[:32, :48]
    pixels = np.stack([5 * y, 4 * x, 0 * x + 60 + 10 * t], -1).clip(0, 255).astype(np.uint8)
    pixels[4 + t : 12 + t, 8 + 2 * t : 20 + 2 * t] = [250, 220, 20]
    return pixels


def write(name, codec, pixels, options, times):
    path = here / f"odd-{name}.mp4"
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = 48, 32, pixels
        stream.codec_context.time_base = Fraction(1, 1000)
        for t, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(image(t), format="rgb24").reformat(format=pixels)
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    with av.open(str(path)) as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert len(frames) == len(times), (name, len(frames))
    Image.fromarray(np.concatenate(frames)).save(here / f"odd-{name}.png")


even = [100 * t for t in range(14)]
# Frames of different durations, a late start, references to later frames, and open groups of frames.
uneven = [350 + 40 * t + 11 * t * t for t in range(14)]
write("times", "libx264", "yuv420p", {"g": "6", "bf": "3", "x264-params": "open-gop=1:b-pyramid=2"}, uneven)
write("deep", "libx264", "yuv420p10le", {"g": "5", "bf": "2"}, even)
write("hevc", "libx265", "yuv420p", {"x265-params": "keyint=7:bframes=3:log-level=none"}, even)
