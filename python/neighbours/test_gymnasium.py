"""Gymnasium's wrappers and vector environments around native environments."""

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers

import stable_worldmodel as swm  # noqa: F401


def test_record_video_writes_a_video_of_each_episode(tmp_path):
    env = gymnasium.make("swm/TwoRoom-v1", render_mode="rgb_array", max_episode_steps=6, image_shape=(64, 64))
    env = wrappers.RecordVideo(env, str(tmp_path / "videos"), episode_trigger=lambda episode: True)
    for episode in range(2):
        env.reset(seed=episode)
        while not any(env.step(env.action_space.sample())[2:4]):
            pass
    env.close()
    videos = sorted((tmp_path / "videos").glob("*.mp4"))
    assert len(videos) == 2 and all(video.stat().st_size > 500 for video in videos)


@pytest.mark.parametrize("mode", ["sync", "async"])
@pytest.mark.parametrize("name", ["swm/TwoRoom-v1", "swm/CartPoleControl-v1"])
def test_vector_environments_reset_themselves(name, mode):
    envs = gymnasium.make_vec(name, num_envs=3, vectorization_mode=mode, max_episode_steps=4)
    envs = wrappers.vector.RecordEpisodeStatistics(envs)
    observation, _ = envs.reset(seed=1)
    assert envs.observation_space.contains(observation)
    ended = 0
    for _ in range(11):
        observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
        assert reward.shape == (3,) and envs.observation_space.contains(observation)
        ended += int((terminated | truncated).sum())
        if "episode" in info:
            lengths = info["episode"]["l"][info["_episode"]]
            assert (lengths <= 4).all() and (lengths > 0).all()
    envs.close()
    assert ended >= 6


@pytest.mark.parametrize("wrap", [
    wrappers.FlattenObservation,
    wrappers.NormalizeObservation,
    wrappers.ClipAction,
    lambda env: wrappers.FrameStackObservation(env, 3),
    lambda env: wrappers.AddRenderObservation(env, render_only=True),
    lambda env: wrappers.RescaleAction(env, np.float32(-2), np.float32(2)),
])  # fmt: skip
def test_wrappers_of_gymnasium_fit(wrap):
    env = wrap(gymnasium.make("swm/TwoRoom-v1", render_mode="rgb_array", image_shape=(32, 32)))
    observation, _ = env.reset(seed=0)
    assert np.shape(observation) == env.observation_space.shape
    observation, *_ = env.step(env.action_space.sample())
    assert np.shape(observation) == env.observation_space.shape
