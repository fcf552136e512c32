"""TorchRL's `GymEnv` with native environments."""

import pytest

import stable_worldmodel as swm  # noqa: F401

torch = pytest.importorskip("torch")
torchrl = pytest.importorskip("torchrl")

from torchrl.envs.libs.gym import GymEnv  # noqa: E402
from torchrl.envs.utils import check_env_specs  # noqa: E402


@pytest.mark.parametrize("name", ["swm/TwoRoom-v1", "swm/PushT-v1", "swm/CartPoleControl-v1", "swm/PushT-Discrete-v1"])
def test_rollouts_fit_the_specs(name):
    env = GymEnv(name)
    check_env_specs(env)
    env.set_seed(4)
    rollout = env.rollout(5)
    assert rollout.batch_size == torch.Size([5]) and rollout["next", "reward"].shape == (5, 1)


def test_frames_are_observations():
    env = GymEnv("swm/TwoRoom-v1", from_pixels=True, pixels_only=False, image_shape=(32, 32))
    assert env.rollout(3)["pixels"].shape == (3, 32, 32, 3)
