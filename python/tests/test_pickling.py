"""Public objects survive pickling, as Ray and worker processes do it; those that cannot say so."""

import pickle

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel import data

torch = pytest.importorskip("torch")


class ToTarget(torch.nn.Module):
    def get_cost(self, info_dict, action_candidates):
        return (action_candidates - 0.3).square().sum((2, 3))


def copied(value):
    return pickle.loads(pickle.dumps(value))


@pytest.fixture
def rooms(tmp_path):
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16), max_episode_steps=5)
    world.collect(tmp_path / "rooms.lance", policy=swm.policy.RandomPolicy(0), episodes=3, seed=0, progress=False)
    return tmp_path / "rooms.lance"


def test_a_policy_leaves_its_world():
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16), max_episode_steps=5)
    planner = swm.policy.MPCPolicy(swm.solver.CEMSolver(ToTarget(), num_samples=8, n_steps=2, topk=2), swm.PlanConfig(3, 2))
    seeds = []
    for policy in (swm.policy.RandomPolicy(3), planner):
        world.set_policy(policy)
        twin = copied(policy)
        assert twin.env is None and policy.env is world.envs
        seeds = [world.evaluate(policy=one, episodes=2, seed=1, floor=False, progress=False) for one in (policy, twin)]
        assert seeds[0]["steps"].tolist() == seeds[1]["steps"].tolist()
    assert copied(seeds[0])["success_rate"] == seeds[0]["success_rate"]
    for one in (world, world.envs):
        with pytest.raises(TypeError, match="create it in the process that uses it"):
            pickle.dumps(one)


def test_a_loader_continues_at_its_position(rooms):
    loader = data.Loader(rooms, batch_size=4, num_steps=2, columns=["state"], seed=3)
    batches = iter(loader)
    next(batches)
    loader.load_state_dict(loader.state_dict())
    twin = copied(loader)
    for one, other in zip(loader, twin, strict=True):
        assert torch.equal(one["state"], other["state"])
    assert twin.state_dict() == loader.state_dict()


def test_a_replay_buffer_keeps_its_episodes(rooms):
    buffer = data.ReplayBuffer(max_steps=40, history_len=2, seed=5, key_filter=lambda_free)
    dataset = data.load_dataset(rooms)
    for episode in range(3):
        buffer.write_episode(dataset.load_episode(episode))
    twin = copied(buffer)
    assert twin.lengths.tolist() == buffer.lengths.tolist() and twin.column_names == buffer.column_names == ["state"]
    assert np.array_equal(twin.sample(8, step=4)["state"], buffer.sample(8, step=4)["state"])
    twin.write_episode(dataset.load_episode(0))
    assert len(copied(data.ReplayBuffer(max_steps=4))) == 0


def lambda_free(episode):
    return {"state": episode["state"]}


def test_visual_wrappers_keep_their_episode():
    env = swm.wrapper.OcclusionWrapper(gymnasium.make("swm/TwoRoom-v1", image_shape=(32, 32)), num_patches=2)
    for seed in (4, None):
        env.reset(seed=seed)
        env.step(env.action_space.sample())
        assert np.array_equal(copied(env).render(), env.render())


def test_a_model_of_the_engine_is_loaded_again():
    model = swm.wm.load("zoo:two-room/pldm")
    twin = copied(model)
    assert twin.card == model.card and twin.path == model.path
    assert copied(swm.solver.CEMSolver(model)).model.path == model.path
