"""Episodes for the viewer of Rerun, verified by its own program."""

import subprocess
import sys

import numpy as np
import pytest

import stable_worldmodel as swm

pytest.importorskip("rerun")


def rerun(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", *arguments], check=True, capture_output=True, text=True
    ).stdout


def test_exported_episodes_are_verified(tmp_path):
    data, file = tmp_path / "rooms.lance", tmp_path / "rooms.rrd"
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(64, 64), max_episode_steps=9)
    world.collect(data, policy=swm.policy.RandomPolicy(), episodes=3, seed=0, options={"variation": ["all"]})
    swm.data.export(data, file, episodes=2)
    rerun("verify", str(file))
    printed = rerun("print", str(file))
    for part in ("/episode_0/pixels", "/episode_1/action", "/episode_1/about", "EncodedImage:blob", "Scalars:scalars"):
        assert part in printed
    with pytest.raises(RuntimeError, match="not written"):
        swm.data.export(data, tmp_path / "rooms.mcap")


def test_depth_and_segmentation_are_images_of_their_kind(tmp_path):
    with swm.data.open_writer(tmp_path / "views.lance") as writer:
        rows = {
            "depth": np.linspace(1, 3, 4 * 8 * 8, dtype=np.float32).reshape(4, 8, 8),
            "segmentation": np.arange(-1, 4 * 8 * 8 - 1, dtype=np.int32).reshape(4, 8, 8) % 5,
            "wide": np.zeros((4, 300), np.float32),
        }
        writer.write_episode(rows)
    swm.data.export(tmp_path / "views.lance", tmp_path / "views.rrd")
    printed = rerun("print", str(tmp_path / "views.rrd"))
    assert "DepthImage:buffer" in printed and "SegmentationImage:buffer" in printed and "wide" not in printed
