"""Composes `hero.webp`, the animation of the README, from episodes that these commands write:

    swm collect swm/OGBScene-v0 -o scene --format folder --codec png --policy expert --episodes 4 --seed 3 --image 224 \
        --variation all --max-steps 160
    swm eval zoo:two-room/pldm expert --env swm/TwoRoom-v1 --episodes 8 --seed 1 --image 64 --videos 8 -o rooms
    ffmpeg -i rooms/videos/NAME-in-distribution-0.mp4 rooms/NAME-%03d.png     # NAME: expert, pldm, random
    python docs/media/hero.py scene rooms docs/media/hero.webp
"""

import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

SIDE, GAP, LABEL, FRAMES = 224, 4, 26, 100
FONT = Path(__file__).parents[2] / "crates/swm-report/fonts/Roboto-subset.ttf"


def scene(folder, episode):
    """The frames of an episode of a dataset in the format folder."""
    paths = sorted((folder / "pixels").glob(f"ep_{episode}_step_*"), key=lambda path: int(path.stem.rsplit("_", 1)[1]))
    return [Image.open(path).convert("RGB") for path in paths]


def room(folder, policy, goal=False):
    """The frames of a video of an evaluation: the environment is on the left, the goal on the right."""
    frames = [Image.open(path).convert("RGB") for path in sorted(folder.glob(f"{policy}-*.png"))]
    half = frames[0].width // 2
    box = (half, 0, 2 * half, half) if goal else (0, 0, half, half)
    # Two frames for each step, so that both rows take about as long.
    return [frame.crop(box).resize((SIDE, SIDE), Image.Resampling.LANCZOS) for frame in frames for _ in range(2)]


def main(scenes, rooms, output):
    rows = [
        ("OGBench scene: the expert, all factors of variation sampled", [scene(scenes, episode) for episode in range(4)]),
        ("", [room(rooms, "expert"), room(rooms, "pldm"), room(rooms, "random"), room(rooms, "pldm", goal=True)]),
    ]
    names = ["Two-Room: expert", "world model (PLDM) plans", "random policy", "goal"]
    font = ImageFont.truetype(str(FONT), 15)
    width = 4 * SIDE + 3 * GAP
    pages = []
    for at in range(FRAMES):
        page = Image.new("RGB", (width, 2 * (SIDE + LABEL)), "white")
        draw = ImageDraw.Draw(page)
        for index, (title, episodes) in enumerate(rows):
            top = index * (SIDE + LABEL)
            draw.text((2, top + 4), title, fill=(27, 36, 48), font=font)
            for column, frames in enumerate(episodes):
                left = column * (SIDE + GAP)
                if not title:
                    draw.text((left + 2, top + 4), names[column], fill=(27, 36, 48), font=font)
                page.paste(frames[min(at, len(frames) - 1)], (left, top + LABEL))
        pages.append(page)
    pages[0].save(output, save_all=True, append_images=pages[1:], duration=66, loop=0, quality=60, method=3)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3])
