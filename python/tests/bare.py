"""Checks the wheel with only its required dependencies installed: a fast import, no import of torch, and basic functions."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main() -> None:
    begun = time.perf_counter()
    import stable_worldmodel as swm

    seconds = time.perf_counter() - begun
    heavy = {"torch", "numpy", "gymnasium", "stable_worldmodel._engine"} & set(sys.modules)
    assert not heavy, f"importing the package loads {heavy}"

    process_seconds = []
    for _ in range(5):
        begun = time.perf_counter()
        subprocess.run([sys.executable, "-c", "import stable_worldmodel"], check=True)
        process_seconds.append(time.perf_counter() - begun)
    print(f"import: {1e3 * seconds:.0f} ms, a Python process that only imports it: {1e3 * sorted(process_seconds)[2]:.0f} ms")

    begun = time.perf_counter()
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(32, 32))
    print(f"the first world: {1e3 * (time.perf_counter() - begun):.0f} ms more")
    # The portable wheel is linked with a small FFmpeg of its own; elsewhere its libraries are loaded for the first video.
    bundled = Path(swm.__file__).parents[1] / "stable_worldmodel_rs.libs"
    assert bundled.exists() or "libavcodec" not in Path("/proc/self/maps").read_text()
    world.set_policy(swm.policy.ExpertPolicy())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rooms.lance"
        assert world.collect(path, episodes=2, seed=0)["episodes"] == 2
        dataset = swm.data.load_dataset(str(path), num_steps=2)
        assert dataset[0]["pixels"].shape == (2, 3, 32, 32)
        print(world.evaluate(episodes=3, seed=0))
    assert "torch" not in sys.modules
    swm_command = Path(sys.executable).with_name("swm")
    assert "swm/PushT-v1" in subprocess.run([swm_command, "envs"], check=True, capture_output=True, text=True).stdout
    wrong = subprocess.run([swm_command, "fovs", "pusht"], capture_output=True, text=True)
    assert wrong.returncode == 2 and "swm/PushT-v1" in wrong.stderr, wrong


if __name__ == "__main__":
    main()
