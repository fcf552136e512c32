"""A user's subclass of what the engine runs is called: policies, solvers and wrappers."""

import functools

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


def traced(method):
    """A decorator as users write them, which keeps the name and the module."""

    @functools.wraps(method)
    def still(self, *given, **named):
        result = method(self, *given, **named)
        return {**result, "actions": result["actions"] * 0} if isinstance(result, dict) else result * 0

    return still


@pytest.mark.parametrize("where", ["subclass", "object", "class"])
def test_decorated_methods_are_called(world, where, monkeypatch):
    kind, policy = swm.policy.RandomPolicy, swm.policy.RandomPolicy(1)
    if where == "subclass":
        policy = type("Traced", (kind,), {"get_action": traced(kind.get_action)})(1)
    elif where == "object":
        policy.get_action = traced(kind.get_action).__get__(policy)
    else:
        monkeypatch.setattr(kind, "get_action", traced(kind.get_action))
    world.set_policy(policy)
    world.reset(seed=1)
    world.step()
    assert (world.infos["action"] == 0).all()


class Far:
    """The cost of a candidate is its distance from 0.7."""

    def get_cost(self, infos, candidates):
        return ((candidates - 0.7) ** 2).sum((2, 3))


def test_decorated_solver_is_called(world):
    kind = type("Traced", (planning.CEMSolver,), {"solve": traced(planning.CEMSolver.solve)})
    solver = kind(Far(), num_samples=16, n_steps=1, topk=4)
    world.set_policy(swm.policy.MPCPolicy(solver, swm.PlanConfig(horizon=1, receding_horizon=1)))
    world.reset(seed=1)
    world.step()
    assert (world.infos["action"] == 0).all()


class Delegating:
    """Passes on what it does not have itself to a model of the engine."""

    def __init__(self, model):
        self.model, self.calls = model, 0

    def __getattr__(self, name):
        return getattr(self.__dict__["model"], name)

    def get_cost(self, infos, candidates):
        self.calls += 1
        return self.model.get_cost(infos, candidates)


class Counting(swm.wm.Model):
    """A model of the engine that counts its costs."""

    def __init__(self, name):
        super().__init__(name)
        self.calls = 0

    def get_cost(self, infos, candidates):
        self.calls += 1
        return super().get_cost(infos, candidates)


@pytest.mark.parametrize("make", [Counting, lambda name: Delegating(swm.wm.load(name))])
def test_cost_of_a_models_subclass_is_called_and_its_plans_are_those_of_the_model(make):
    actions = []
    for model in (swm.wm.load("zoo:two-room/pldm"), make("zoo:two-room/pldm")):
        with swm.World("swm/TwoRoom-v1", 1, image_shape=(64, 64)) as world:
            solver = planning.CEMSolver(model, num_samples=32, n_steps=2, topk=4, seed=0)
            config = swm.PlanConfig(horizon=1, receding_horizon=1, action_block=model.action_block)
            world.set_policy(swm.policy.MPCPolicy(solver, config))
            world.reset(seed=1)
            world.step()
            actions.append(world.infos["action"].copy())
    assert model.calls == 2
    assert np.allclose(*actions, atol=1e-5)
