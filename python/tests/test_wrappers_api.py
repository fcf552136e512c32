"""Tests of the wrappers that fill infos, of `EnvPool`, of transforms of frames, and of the classes of environments."""

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel import wrapper
from stable_worldmodel.world.env_pool import EnvPool


class Counter(gymnasium.Env):
    """An environment whose observation is the number of steps, and whose frame has that brightness."""

    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gymnasium.spaces.Box(0, 99, (1,), np.float32)
    render_mode = "rgb_array"

    def __init__(self, **more):
        self.more = more

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.array([0.0], np.float32), {"goal": np.full((20, 30, 3), 9, np.uint8), **self.more}

    def step(self, action):
        self.t += 1
        info = {"goal": np.full((20, 30, 3), 9, np.uint8), "text": f"t{self.t}"}
        return np.array([self.t], np.float32), float(self.t), self.t == 3, False, info

    def render(self):
        return np.full((20, 30, 3), self.t, np.uint8)


def test_mega_wrapper_puts_everything_into_infos():
    env = wrapper.MegaWrapper(Counter(), image_shape=(10, 12), required_keys=["goal"])
    _, info = env.reset(seed=0)
    assert info["pixels"].shape == info["goal"].shape == (10, 12, 3)
    assert np.isnan(info["action"]).all() and np.isnan(info["reward"]) and info["step_idx"] == 0
    episode = info["id"]
    for step in (1, 2, 3):
        action = np.array([0.5, step / 4], np.float32)
        _, _, _, _, info = env.step(action)
        assert info["observation"] == info["reward"] == info["step_idx"] == step and info["id"] == episode
        assert (info["pixels"] == step).all() and np.array_equal(info["action"], action)
        assert info["terminated"] == (step == 3) and info["truncated"] is False and info["render_time"] >= 0
    assert env.reset(seed=1)[1]["id"] != episode and env.reset(seed=0)[1]["id"] == episode
    with pytest.raises(RuntimeError, match="state"):
        wrapper.MegaWrapper(Counter(), required_keys=["state"]).reset()
    with pytest.raises(ValueError, match="reward"):
        wrapper.EverythingToInfoWrapper(Counter(reward=1)).reset()
    bare = wrapper.MegaWrapper(Counter(), add_pixels=False)
    assert "pixels" not in bare.reset()[1] and bare.reset()[1]["goal"].shape == (20, 30, 3)


def test_the_other_wrappers_check_and_rename():
    env = wrapper.MapKeysWrapper(wrapper.EverythingToInfoWrapper(Counter()), {"observation": "count"})
    assert "observation" not in env.reset()[1] and env.step(env.action_space.sample())[4]["count"] == 1
    with pytest.raises(KeyError, match="nothing"):
        wrapper.MapKeysWrapper(Counter(), {"nothing": "x"}).reset()
    wrapper.EnsureImageShape(Counter(), "goal", (20, 30)).reset()
    with pytest.raises(RuntimeError, match="20, 30, 3"):
        wrapper.EnsureImageShape(Counter(), "goal", (30, 20)).reset()
    wrapper.EnsureGoalInfoWrapper(Counter(), check_reset=True).reset()
    scaled = wrapper.AddPixelsWrapper(Counter(), (4, 6), lambda image: np.asarray(image).mean(), resample=0)
    scaled.reset()
    assert scaled.step(None)[4]["pixels"] == 1.0
    with pytest.raises(ValueError, match="sharp"):
        wrapper.MegaWrapper(Counter(), image_resample="sharp")


def test_wrappers_of_a_native_environment_show_its_factors():
    env = wrapper.MegaWrapper(gymnasium.make("swm/TwoRoom-v1", render_mode="rgb_array"), image_shape=(32, 32))
    _, info = env.reset(seed=3, options={"variation": ["agent.color"]})
    factor = env.unwrapped.variation_space["agent"]["color"].value
    assert np.array_equal(info["variation.agent.color"], factor) and info["pixels"].shape == (32, 32, 3)
    assert np.array_equal(env.step(env.action_space.sample())[4]["variation.agent.color"], factor)
    with pytest.raises(ValueError, match="list of factors"):
        env.reset(options={"variation": "all"})


def test_env_pool_steps_chosen_environments():
    pool = EnvPool([lambda: wrapper.EverythingToInfoWrapper(Counter())] * 3)
    with pytest.raises(RuntimeError, match="reset"):
        pool.step(np.zeros((3, 2)))
    _, infos = pool.reset(seed=[5, None, 7])
    assert infos["observation"].shape == (3, 1, 1) and infos["goal"].shape == (3, 1, 20, 30, 3)
    assert pool.seeds.tolist() == [5, -1, 7] and pool.action_space.shape == (3, 2) and pool.num_envs == 3
    actions = np.arange(6, dtype=np.float32).reshape(3, 2) / 6
    _, rewards, terminateds, _, stepped = pool.step(actions, mask=[True, False, True])
    assert stepped is infos and rewards.tolist() == [1, 0, 1] and not terminateds.any()
    assert infos["observation"].ravel().tolist() == [1, 0, 1]
    assert np.array_equal(infos["action"][[0, 2], 0], actions[[0, 2]]) and np.isnan(infos["action"][1]).all()
    pool.step(actions)
    _, _, terminateds, _, _ = pool.step(actions)
    assert terminateds.tolist() == [True, False, True]
    pool.reset(seed=9, mask=[True, False, False])
    assert infos["observation"].ravel().tolist() == [0, 2, 3] and pool.seeds.tolist() == [9, -1, 7]
    with pytest.raises(ValueError, match="3 values"):
        pool.reset(seed=[1])


class Acting(gymnasium.Env):
    """Keeps the actions of an action space."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, action_space):
        self.action_space, self.taken = action_space, []

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.taken.append(action)
        return np.zeros(1, np.float32), 0.0, False, False, {}


PARTS = (gymnasium.spaces.Discrete(3), gymnasium.spaces.Box(0, 1, (2,), np.float32), gymnasium.spaces.Text(4))


@pytest.mark.parametrize(
    "space",
    [
        gymnasium.spaces.Tuple((gymnasium.spaces.Discrete(3), gymnasium.spaces.Discrete(100, start=5))),
        gymnasium.spaces.Tuple(PARTS),
        gymnasium.spaces.Dict(dict(zip("abc", PARTS, strict=True))),
        gymnasium.spaces.Tuple((gymnasium.spaces.Dict(a=PARTS[0]), gymnasium.spaces.Tuple(PARTS[:2]))),
    ],
)
@pytest.mark.parametrize("envs", [2, 3])
def test_pools_step_with_samples_of_their_action_space(space, envs):
    pool = EnvPool([lambda: Acting(space)] * envs)
    pool.reset(seed=0)
    pool.action_space.seed(3)
    sampled = pool.action_space.sample()
    pool.step(sampled)
    taken = [env.taken[0] for env in pool.envs]
    # One action for each environment, in a list or a tuple.
    pool.step(taken)
    pool.step(tuple(taken))
    for env, first in zip(pool.envs, taken, strict=True):
        for other in env.taken[1:]:
            assert repr(other) == repr(first)
    first = sampled["a"] if isinstance(space, gymnasium.spaces.Dict) else sampled[0]
    first = first["a"] if isinstance(first, dict) else first
    firsts = [action["a"] if isinstance(action, dict) else action[0] for action in taken]
    assert [value["a"] if isinstance(value, dict) else value for value in firsts] == first.tolist()
    with pytest.raises(ValueError, match=f"expected {envs} actions, one for each environment"):
        pool.step(taken[:1])


class Changing(gymnasium.Env):
    """Returns infos of other types and shapes than at its reset, one at a time."""

    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, terminated=False, **infos):
        self.end, self.later = terminated, infos

    def reset(self, *, seed=None, options=None):
        infos = {"count": 2, "small": np.uint8(7), "vector": np.zeros(3, np.float32), "name": "a"}
        return np.zeros(1, np.float32), infos

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, self.end, False, self.later


@pytest.mark.parametrize(
    ("later", "words"),
    [
        ({"count": 1.5}, r"info\['count'\]: got float64 of shape \(\), expected int64"),
        ({"small": np.int64(300)}, r"info\['small'\]: 300 is stored as uint8"),
        ({"vector": np.float32(5)}, r"info\['vector'\]: got float32 of shape \(\), expected float32 of shape \(3,\)"),
        ({"terminated": float("nan")}, "terminated: nan; expected true or false"),
        ({"terminated": -1}, "terminated: -1; expected true or false"),
    ],
)
def test_pools_refuse_values_that_their_infos_cannot_hold(later, words):
    pool = EnvPool([lambda: Changing(**later)] * 2)
    pool.reset(seed=0)
    with pytest.raises(ValueError, match=words):
        pool.step(np.zeros((2, 1)))


def test_pools_convert_values_that_their_infos_can_hold():
    pool = EnvPool([lambda: Changing(terminated=np.True_, count=np.int32(5), small=8, vector=[1.0, 2.0, 3.0], name="b")] * 2)
    pool.reset(seed=0)
    _, _, terminateds, _, infos = pool.step(np.zeros((2, 1)))
    assert terminateds.all() and infos["count"].ravel().tolist() == [5, 5] and infos["small"].dtype == np.uint8
    assert infos["vector"][1, 0].tolist() == [1, 2, 3] and infos["name"] == [["b"], ["b"]]


class Hitting(gymnasium.Env):
    """Says whether it hit something from its second step on, in the first episode only, and returns one reward."""

    observation_space, action_space = gymnasium.spaces.Box(-1, 1, (1,)), gymnasium.spaces.Discrete(3)

    def __init__(self, reward=1.0, name=None):
        self.reward, self.name, self.resets = reward, name, 0

    def reset(self, *, seed=None, options=None):
        self.resets, self.steps = self.resets + 1, 0
        infos = {"name": self.name} if self.name else {"score": np.float32(2)}
        return np.zeros(1, np.float32), {**infos, "hit": False} if self.resets == 1 else infos

    def step(self, action):
        self.steps += 1
        infos = {"hit": self.steps > 1} if self.resets == 1 else {}
        return np.zeros(1, np.float32), self.reward, False, False, infos


@pytest.mark.parametrize("reward", [None, "3", np.complex64(1 + 2j), 1e300, [1.0, 2.0]])
def test_pools_refuse_rewards_that_are_no_numbers_of_single_precision(reward):
    pool = EnvPool([lambda: Hitting(reward)])
    pool.reset(seed=0)
    with pytest.raises(ValueError, match="reward: .*; expected a number"):
        pool.step([0])


def test_infos_of_pools_are_those_of_the_episode():
    pool = EnvPool([Hitting, lambda: Hitting(np.ones(1), "b")])
    _, infos = pool.reset(seed=5)
    assert infos["score"].ravel().tolist() == [2, 0] and infos["name"] == [[None], ["b"]]
    pool.step([0, 0])
    _, rewards, *_, infos = pool.step([0, 0])
    assert infos["hit"].ravel().tolist() == [True, True] and rewards.tolist() == [1, 1]
    _, infos = pool.reset(mask=[True, False])
    assert infos["hit"].ravel().tolist() == [False, True] and pool.seeds.tolist() == [-1, 6]
    pool.reset()
    assert pool.seeds.tolist() == [-1, -1]
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16))
    world.reset(seed=0)
    for wrong in ([True, False, True], [True], [2, 0], [[True, True]], ["True", "False"], [0.2, 0]):
        with pytest.raises(ValueError, match="mask: expected 2 values, true or false"):
            world.envs.step(np.zeros((2, 2)), mask=wrong)
        with pytest.raises(ValueError, match="mask: expected 2 values, true or false"):
            world.envs.reset(mask=wrong)
        with pytest.raises(ValueError, match="mask: expected 2 values, true or false"):
            pool.step([0, 0], mask=wrong)
        with pytest.raises(ValueError, match="mask: expected 2 values, true or false"):
            pool.reset(mask=wrong)


def test_the_environments_of_a_world_are_a_pool():
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16))
    assert isinstance(world.envs, EnvPool)
    _, infos = world.envs.reset(seed=3)
    before = infos["state"].copy()
    _, rewards, terminateds, truncateds, infos = world.envs.step(np.ones((2, 2), np.float32), mask=[True, False])
    moved = np.abs(infos["state"] - before).max((1, 2))
    assert moved[0] > 0 and moved[1] == 0 and rewards.shape == terminateds.shape == truncateds.shape == (2,)
    assert rewards[1] == 0
    # Each environment has options of its own.
    colours = [[255, 0, 0], [0, 0, 255]]
    world.reset(seed=3, options=[{"variation_values": {"agent.color": colour}} for colour in colours])
    assert [world.factors(env)["agent.color"] for env in range(2)] == colours
    world.set_policy(swm.policy.RandomPolicy(seed=0))
    world.step(3)
    with pytest.raises(ValueError, match="2 dicts"):
        world.reset(options=[{}])


def test_transforms_change_the_frames_that_policies_get(tmp_path):
    shapes = []

    class Records(swm.policy.BasePolicy):
        def get_action(self, infos):
            shapes.append((infos["pixels"].shape, infos["goal"].dtype))
            return self.env.action_space.sample()

    world = swm.World(
        "swm/TwoRoom-v1",
        num_envs=2,
        image_shape=(16, 16),
        image_transform=lambda image: np.asarray(image)[::2, ::4].mean(2),
        goal_transform=lambda image: np.asarray(image) / 255,
        max_episode_steps=5,
    )
    plain = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16))
    world.reset(seed=1)
    plain.reset(seed=1)
    assert np.allclose(world.infos["pixels"], plain.infos["pixels"][:, :, ::2, ::4].mean(-1))
    assert np.allclose(world.infos["goal"], plain.infos["goal"] / 255)
    world.set_policy(Records())
    world.step(2)
    world.collect(tmp_path / "rooms.lance", episodes=2, seed=0, progress=False)
    assert set(shapes) == {((2, 1, 8, 4), np.dtype(np.float64))}
    assert swm.data.load_dataset(tmp_path / "rooms.lance", backend="numpy")[0]["pixels"].shape == (1, 3, 16, 16)
    with pytest.raises(TypeError, match="image_transform"):
        swm.World("swm/TwoRoom-v1", image_transform=3)


def test_classes_of_environments_equal_the_registered_ones():
    from stable_worldmodel.envs.gymnasium_control.cartpole import CartPoleWrapper
    from stable_worldmodel.envs.piecewise.piecewise_env import PiecewiseEnv
    from stable_worldmodel.envs.pusht import PushT, PushTDiscrete
    from stable_worldmodel.envs.simple_point_maze import SimplePointMazeEnv
    from stable_worldmodel.envs.two_room import TwoRoomEnv

    for kind, name in (
        (PushT, "swm/PushT-v1"),
        (PushTDiscrete, "swm/PushT-Discrete-v1"),
        (TwoRoomEnv, "swm/TwoRoom-v1"),
        (PiecewiseEnv, "swm/Piecewise-v0"),
        (SimplePointMazeEnv, "swm/SimplePointMaze-v0"),
        (CartPoleWrapper, "swm/CartPoleControl-v1"),
    ):
        env, registered = kind(render_mode="rgb_array"), gymnasium.make(name)
        (_, one), (_, other) = env.reset(seed=4), registered.reset(seed=4)
        assert env.action_space == registered.action_space
        assert all(np.array_equal(one[key], other[key]) for key in other), name
        assert env.render().shape == (224, 224, 3)
    with pytest.raises(ValueError, match="relative"):
        PushT(relative=False)
    assert SimplePointMazeEnv().render("rgb_array").shape == (224, 224, 3)


def test_initial_values_of_factors_hold_unless_they_are_varied():
    from stable_worldmodel.envs.two_room import TwoRoomEnv

    env = TwoRoomEnv(init_value={"agent": {"color": [1, 2, 3]}})
    colour = lambda **options: env.reset(seed=0, options=options) and env.variation_space["agent"]["color"].value.tolist()  # noqa: E731
    assert colour() == [1, 2, 3] and colour(variation=["agent.color"]) != [1, 2, 3]
    assert colour(variation=["all"]) != [1, 2, 3] and colour(variation_values={"agent.color": [7, 8, 9]}) == [7, 8, 9]
    with pytest.raises(ValueError, match="agent.size_of"):
        TwoRoomEnv(init_value={"agent.size_of": 1})


def test_experts_of_the_modules_play_as_the_engine_experts(tmp_path):
    from stable_worldmodel.envs.pusht import WeakPolicy
    from stable_worldmodel.envs.two_room import ExpertPolicy

    def states(policy, env="swm/TwoRoom-v1"):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.lance"
        world = swm.World(env, num_envs=2, image_shape=(16, 16), max_episode_steps=12)
        world.collect(path, episodes=2, seed=3, policy=policy, progress=False)
        return swm.data.load_dataset(path, backend="numpy").get_col_data("action")

    plain = states(swm.policy.ExpertPolicy())
    assert np.array_equal(states(ExpertPolicy()), plain, equal_nan=True)
    noisy = states(ExpertPolicy(action_noise=0.3))
    assert len(noisy) != len(plain) or not np.allclose(noisy, plain, equal_nan=True)
    weak = states(WeakPolicy(seed=1), "swm/PushT-v1")
    assert np.array_equal(weak, states(swm.policy.ExpertPolicy("weak", seed=1), "swm/PushT-v1"), equal_nan=True)
    with pytest.raises(ValueError, match="door_fit_margin"):
        ExpertPolicy(door_fit_margin=2.0)


@pytest.mark.parametrize(("rings", "sectors"), [(2, 16), (16, 16), (4, 36)])
def test_cells_of_the_polar_quantizer_are_found_again(rings, sectors):
    from stable_worldmodel.envs.quantizer import PolarQuantizer

    grid = PolarQuantizer(rings, sectors, 1.0)
    for cell in np.ndindex(rings, sectors):
        assert tuple(grid.quantize(grid.dequantize(cell))) == cell


def test_polar_quantizer():
    from stable_worldmodel.envs.quantizer import PolarQuantizer

    grid = PolarQuantizer(4, 8, 2.0)
    assert grid.action_shape == (4, 8)
    for cell in ([0, 0], [3, 7], [2, 5]):
        assert np.allclose(np.hypot(*grid.dequantize(cell)), (cell[0] + 0.5) / 2)
        # The first angle of a cell is its edge, so a small turn is inside of it.
        x, y = grid.dequantize(cell)
        turn = 0.01
        inside = [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)]
        assert grid.quantize(inside).tolist() == cell
    assert grid.quantize([9.0, 0.0]).tolist() == [3, 0]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((1, 0.5), [1.0, 0.5]),
        ((0.5, 1), [0.5, 1.0]),
        ((1, "a"), [[1], ["a"]]),
        ((3.5, None), [[3.5], [None]]),
        ((True, 2), [1, 2]),
    ],
)
def test_infos_of_different_types_do_not_depend_on_the_order_of_environments(values, expected):
    def envs(given):
        made = [Changing() for _ in given]
        for env, value in zip(made, given, strict=True):
            env.reset = lambda value=value, **_: (np.zeros(1, np.float32), {"x": value})
        return [lambda env=env: env for env in made]

    found = EnvPool(envs(values)).reset()[1]["x"]
    assert (found if isinstance(found, list) else found.ravel().tolist()) == expected
    found = EnvPool(envs(values[::-1])).reset()[1]["x"]
    assert (found if isinstance(found, list) else found.ravel().tolist()) == expected[::-1]


def test_infos_that_their_common_type_cannot_hold_are_refused():
    pool = EnvPool([lambda: Changing(small=-1, count=np.uint64(2**64 - 1))])
    pool.reset()
    with pytest.raises(ValueError, match="stored as"):
        pool.step([np.zeros(1)])
    pool = EnvPool([lambda: Changing(count=-1)])
    pool.reset()
    pool._infos["count"] = pool._infos["count"].astype(np.uint64)
    with pytest.raises(ValueError, match="-1 is stored as uint64, which cannot hold it"):
        pool.step([np.zeros(1)])
