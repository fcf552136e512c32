"""A user's subclass of what the engine runs is called: policies, solvers and wrappers."""

import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel import planning
from stable_worldmodel.wrapper.visual import NoiseWrapper


@pytest.fixture
def world():
    with swm.World("swm/TwoRoom-v1", 2, image_shape=(32, 32), max_episode_steps=6) as world:
        yield world


@pytest.mark.parametrize("kind", [swm.policy.RandomPolicy, swm.policy.ExpertPolicy])
def test_policy_is_called(world, kind):
    class Still(kind):
        def get_action(self, infos, **named):
            return np.zeros((2, 2), np.float32)

    buffer = swm.data.ReplayBuffer(100)
    world.collect(writer=buffer, policy=Still(), episodes=2, seed=1, progress=False)
    assert all((buffer.load_episode(episode)["action"][:-1] == 0).all() for episode in range(2))
    world.reset(seed=1)
    before = world.infos["state"].copy()
    for _ in range(2):
        world.step()
    assert (world.infos["state"] == before).all()


def test_policy_that_acts_otherwise_has_a_name_of_its_own(world, tmp_path):
    class Still(swm.policy.RandomPolicy):
        def get_action(self, infos, **named):
            return np.zeros((2, 2), np.float32)

    class Named(swm.policy.BasePolicy):
        type = "standing"
        get_action = Still.get_action

    for policy, name in ((Still(), "Still"), (Named(), "standing"), (swm.policy.RandomPolicy(), "random")):
        path = tmp_path / f"{name}.h5"
        world.collect(path, policy=policy, episodes=1, seed=1, progress=False)
        assert swm.data.load_dataset(path).manifest["config"]["policy"] == name


def test_policy_may_change_the_actions_of_the_engine(world):
    class Half(swm.policy.RandomPolicy):
        def get_action(self, infos, **named):
            return super().get_action(infos, **named) / 2

    world.set_policy(Half(1))
    world.reset(seed=1)
    seen = []
    for _ in range(5):
        world.step()
        seen.append(world.infos["action"].copy())
    assert 0 < np.abs(seen).max() <= 0.5
    with pytest.raises(RuntimeError, match="MixturePolicy"):
        world.collect(writer=swm.data.ReplayBuffer(100), episodes=1, progress=False)


def test_solver_is_called(world):
    class Sum:
        def get_cost(self, infos, candidates):
            return candidates.reshape(*candidates.shape[:2], -1).sum(-1)

    class Still(planning.CEMSolver):
        def solve(self, *given, **named):
            planned = super().solve(*given, **named)
            return {**planned, "actions": planned["actions"] * 0}

    settings = {"num_samples": 16, "n_steps": 1, "topk": 4}
    config = swm.PlanConfig(horizon=2, receding_horizon=2, action_block=1)
    for kind, moves in ((planning.CEMSolver, True), (Still, False)):
        buffer = swm.data.ReplayBuffer(100)
        policy = swm.policy.MPCPolicy(kind(Sum(), **settings), config=config)
        world.collect(writer=buffer, policy=policy, episodes=2, seed=1, progress=False)
        assert bool(np.abs(buffer.load_episode(0)["action"][:-1]).max() > 0) == moves
    with pytest.raises(ValueError, match="solver of this package"):
        world.collect(
            writer=swm.data.ReplayBuffer(100),
            policy=swm.policy.MPCPolicy(Still("simulator", **settings), config=config),
            episodes=1,
            progress=False,
        )


def test_wrapper_is_called():
    class Dark(NoiseWrapper):
        def apply(self, frame):
            return super().apply(frame) * 0

    with swm.World("swm/TwoRoom-v1", 1, image_shape=(32, 32), extra_wrappers=[Dark]) as world:
        world.reset(seed=1)
        assert world.infos["pixels"].max() == 0


def test_loader_refuses_a_dataset_whose_reading_it_would_bypass(world, tmp_path):
    world.collect(tmp_path / "steps.h5", policy=swm.policy.RandomPolicy(), episodes=2, seed=1, progress=False)
    stored = type(swm.data.load_dataset(tmp_path / "steps.h5"))

    class Doubled(stored):
        def __getitem__(self, index):
            sample = super().__getitem__(index)
            return {**sample, "state": sample["state"] * 2}

    class Annotated(stored):
        """Changes nothing that the engine reads."""

        note = "mine"

    doubled = Doubled(tmp_path / "steps.h5")
    for dataset in (doubled, swm.data.ConcatDataset([doubled, doubled])):
        with pytest.raises(TypeError, match="Doubled.__getitem__; use torch's DataLoader"):
            swm.data.Loader(dataset, batch_size=2)
    assert next(iter(swm.data.Loader(Annotated(tmp_path / "steps.h5"), batch_size=2, columns=["state"]))).keys() == {"state"}
