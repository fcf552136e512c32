"""Behaviour that programs written for the Python package stable-worldmodel rely on, as observed in its release 0.1.1."""

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel import data, spaces
from stable_worldmodel.world.env_pool import EnvPool
from stable_worldmodel.wrapper import MegaWrapper

torch = pytest.importorskip("torch")

BOX = gymnasium.spaces.Box(-1, 1, (2, 3), np.float32)


class ToTarget(torch.nn.Module):
    def get_cost(self, info_dict, action_candidates):
        self.info = info_dict
        return (action_candidates - 0.3).square().sum((2, 3))


class Second(torch.nn.Module):
    """The last option of every choice is the cheapest one."""

    def get_cost(self, info_dict, action_candidates):
        return -action_candidates[..., 2].sum(-1)


def solved(solver, space=BOX, init=None, **config):
    solver.configure(action_space=space, n_envs=2, config=swm.PlanConfig(**{"horizon": 4, "receding_horizon": 2, **config}))
    return solver.solve({"state": torch.zeros(2, 1, 5), "names": ["a", "b"], "task": "reach"}, init_action=init)


def test_results_of_solvers_have_the_final_distribution():
    few = {"num_samples": 20, "n_steps": 3, "topk": 5}
    for kind in (swm.solver.CEMSolver, swm.solver.ICEMSolver, swm.solver.MPPISolver):
        found = solved(kind(ToTarget(), var_scale=0.5, **few))
        assert torch.equal(found["mean"][0], found["actions"]) and found["var"][0].shape == (2, 4, 3)
        assert 0 < found["var"][0].max() <= 0.6
    # The moments without callbacks are those that callbacks get.
    for kind in (swm.solver.CEMSolver, swm.solver.ICEMSolver):
        seen = []

        class Last(swm.solver.callbacks.Callback):
            def compute(self, seen=seen, **state):
                seen[:] = [state]

        watched, plain = (solved(kind(ToTarget(), seed=3, callbacks=given, **few)) for given in ([Last()], None))
        assert torch.allclose(seen[0]["var"], plain["var"][0]) and torch.equal(watched["var"][0], plain["var"][0])
        assert torch.allclose(seen[0]["mean"], plain["mean"][0], atol=1e-6)
    descent = solved(swm.solver.GradientSolver(ToTarget(), n_steps=5, num_samples=3))
    assert len(descent["cost"]) == 1 and len(descent["cost"][0]) == 5 and descent["cost"][0][0] > descent["cost"][0][-1]


def test_models_get_lists_and_texts_of_the_infos():
    model = ToTarget()
    solved(swm.solver.CEMSolver(model, num_samples=8, n_steps=1, topk=2))
    assert model.info["names"] == ["a", "b"] and model.info["task"] == "reach"
    assert model.info["state"].shape == (2, 8, 1, 5)


def test_plans_of_discrete_actions_are_indices():
    space = gymnasium.spaces.Discrete(4)
    search = swm.solver.CategoricalCEMSolver(Second(), num_samples=60, n_steps=6, topk=8, smoothing=0.01)
    found = solved(search, space)
    assert found["actions"].dtype == torch.int64 and found["actions"].shape == (2, 4, 1) and (found["actions"] == 2).all()
    probabilities = found["probs"][0]
    assert probabilities.shape == (2, 4, 1, 4) and torch.allclose(probabilities.sum(-1), torch.ones(2, 4, 1))
    assert torch.equal(probabilities.argmax(-1), found["actions"])
    assert (search.action_dim, search.action_simplex_dim, search.init_probs(2).shape) == (1, 4, (2, 4, 1, 4))
    descent = swm.solver.PGDSolver(Second(), n_steps=8, num_samples=2)
    assert (solved(descent, space, action_block=2, init=found["actions"].repeat(1, 1, 2))["actions"] == 2).all()
    assert (descent.action_dim, descent.action_simplex_dim) == (2, 8)
    # A start of the space counts, and so does a plan given as indices.
    shifted = solved(swm.solver.PGDSolver(Second(), n_steps=8, num_samples=2), gymnasium.spaces.Discrete(4, start=5))
    assert (shifted["actions"] == 7).all()
    with pytest.raises(AssertionError, match="discrete actions"):
        solved(swm.solver.PGDSolver(Second(), n_steps=1))


def test_policies_act_in_any_vectorised_environment():
    envs = gymnasium.make_vec("CartPole-v1", num_envs=2)
    one, other = swm.policy.RandomPolicy(seed=4), swm.policy.RandomPolicy()
    one.set_env(envs)
    first = [one.get_action(None).tolist() for _ in range(8)]
    other.set_env(gymnasium.make_vec("CartPole-v1", num_envs=2))
    other.set_seed(4)
    assert [other.get_action(None).tolist() for _ in range(8)] == first
    pool = EnvPool([lambda: MegaWrapper(gymnasium.make("swm/TwoRoom-v1"), image_shape=(16, 16))] * 2)
    _, infos = pool.reset(seed=0)
    planner = swm.policy.WorldModelPolicy(swm.solver.CEMSolver(Two(), num_samples=8, n_steps=2, topk=2), swm.PlanConfig(2, 1))
    planner.set_env(pool)
    assert planner.get_action(infos).shape == (2, 2)
    expert = swm.policy.ExpertPolicy()
    expert.set_env(pool)
    with pytest.raises(RuntimeError, match="of a World"):
        expert.get_action(infos)
    assert swm.policy.BasePolicy().type == "base"


class Two(torch.nn.Module):
    def get_cost(self, info_dict, action_candidates):
        return action_candidates.square().sum((2, 3))


def test_the_seed_of_a_policy_is_set_with_the_policy():
    class Seeded(swm.policy.BasePolicy):
        seed, given = 7, None

        def set_seed(self, seed):
            self.given = seed

        def get_action(self, infos):
            return self.env.action_space.sample()

    policy = Seeded()
    swm.World("swm/TwoRoom-v1", num_envs=1, image_shape=(16, 16)).set_policy(policy)
    assert policy.given == 7


def test_infos_have_the_factors_that_a_reset_samples():
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16), max_episode_steps=3)
    world.reset(seed=0)
    assert not any(name.startswith("variation") for name in world.infos)
    world.reset(seed=0, options={"variation": ["agent"]})
    names = {name for name in world.infos if name.startswith("variation")}
    assert names == {f"variation.agent.{name}" for name in ("color", "position", "radius", "speed")}
    colour = world.infos["variation.agent.color"]
    assert colour.shape == (2, 1, 3) and colour[1, 0].tolist() == world.factors(1)["agent.color"]
    world.set_policy(swm.policy.RandomPolicy(0))
    for steps in (1, 7):
        world.step(steps)
        assert [world.factors(env)["agent.color"] for env in range(2)] == world.infos["variation.agent.color"][:, 0].tolist()
    world.reset(options={"variation": ["wall.color"]})
    assert [name for name in world.infos if name.startswith("variation")] == ["variation.wall.color"]


def test_spaces_keep_what_they_are_given():
    factor = spaces.Discrete(5, init_value=9)
    assert factor.value == 9 and not factor.check()
    with pytest.raises(AssertionError):
        factor.set_value(7)
    tree = spaces.Dict({"b": spaces.Discrete(2, init_value=0), "a": spaces.Dict({"c": spaces.Discrete(2, init_value=1)})})
    assert tree.names() == ["a.c", "b"] and tree.sampling_order == ["a", "a.c", "b"]
    mixed = spaces.Dict({"plain": gymnasium.spaces.Discrete(3), "factor": spaces.Discrete(3, init_value=1)})
    mixed.reset()
    assert mixed.check() and mixed.init_value["factor"] == 1 and set(mixed.sample()) == {"plain", "factor"}
    with pytest.raises(ValueError, match="plain"):
        _ = mixed.value


@pytest.mark.parametrize("name", ["a.h5", "a.lance"])
def test_episodes_may_have_an_action_in_their_last_row(tmp_path, name):
    episode = {"state": [np.full(3, t, np.float32) for t in range(4)], "action": [np.full(2, t, np.float32) for t in range(4)]}
    with data.open_writer(tmp_path / name) as writer:
        with pytest.warns(UserWarning, match="last row is left out"):
            writer.write_episode(episode)
        writer.write_episode({**episode, "action": episode["action"][:3]})
    actions = data.load_dataset(tmp_path / name).get_col_data("action")
    assert actions[:3].tolist() == [[0, 0], [1, 1], [2, 2]] and np.isnan(actions[[3, 7]]).all()
    assert episode["action"][3].tolist() == [3, 3]


def test_lerobot_addresses_have_a_format():
    assert data.detect_format("lerobot://owner/name").name == "lerobot"


def test_push_t_compares_states():
    from stable_worldmodel.envs.pusht import PushT

    env = PushT()
    goal = np.array([100.0, 100, 200, 200, 0.5, 0, 0])
    for change, solved in (
        ([14, 0, 14, 0, 0, 0, 0], True),
        ([14, 0, 14.5, 0, 0, 0, 0], False),
        ([0, 0, 0, 0, 0.34, 0, 0], True),
        ([0, 0, 0, 0, 0.36, 0, 0], False),
        ([0, 0, 0, 0, 2 * np.pi - 0.2, 50, 0], True),
    ):
        success, distance = env.eval_state(goal, goal + change)
        assert success is solved and np.isclose(distance, np.linalg.norm(change))
        # The environment agrees, where a state can be restored exactly.
        env.reset(seed=0)
        _, info = env.restore_from({"state": goal + change}, {"state": goal})
        assert bool(info["success"]) is solved
