"""Tests of the paper's code listings, with smaller settings, and of user-defined extensions."""

from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel.wrapper.visual import ColorJitterWrapper, NoiseWrapper, OcclusionWrapper

torch = pytest.importorskip("torch")
torch.set_num_threads(1)


class MyWorldModel(torch.nn.Module):
    """A user-defined model: encodes frames, and moves the latent by every action."""

    def __init__(self, actions, latent=8):
        super().__init__()
        self.encoder = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(4), torch.nn.Flatten(), torch.nn.Linear(48, latent))
        self.actions = torch.nn.Linear(actions, latent)

    def get_cost(self, info_dict, action_candidates):
        if "latents" not in info_dict:
            frames = [info_dict[key][:, 0, -1].movedim(-1, 1).float() / 255 for key in ("pixels", "goal")]
            info_dict["latents"] = [self.encoder(one)[:, None] for one in frames]
        start, goal = info_dict["latents"]
        reached = start + self.actions(action_candidates).sum(2)
        return ((reached - goal) ** 2).sum(-1)


def test_listing_collects_trains_and_evaluates(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # 1] Create the world
    world = swm.World(env_name="swm/PushT-v1", num_envs=8, max_episode_steps=12, image_shape=(64, 64))
    # 2] Collect data
    world.set_policy(swm.policy.RandomPolicy(seed=42))
    world.collect(dataset_path=tmp_path / "pusht.lance", episodes=10, seed=42)
    # 3] Train/Load your world model (user-defined)
    dataset = swm.data.load_dataset(str(tmp_path / "pusht.lance"), num_steps=2)
    assert dataset.num_episodes == 10
    model = MyWorldModel(actions=world.single_action_space.shape[0])
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    for batch in torch.utils.data.DataLoader(dataset, batch_size=16, shuffle=True):
        now, after = (model.encoder(batch["pixels"][:, t].float() / 255) for t in (0, 1))
        loss = ((now + model.actions(batch["action"][:, 0].nan_to_num()) - after) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    # 4] Evaluate with planning
    planner = swm.solver.CEMSolver(model, num_samples=16, n_steps=2, topk=4)
    wm_policy = swm.policy.MPCPolicy(planner)
    world.set_policy(wm_policy)
    metrics = world.evaluate(episodes=3, seed=0, video="videos/", options={"variation": ["agent.size", "background.color"]})
    print(metrics["success_rate"])
    assert 0 <= metrics["success_rate"] <= 100 and len(metrics["episode_successes"]) == 3
    assert len(list((tmp_path / "videos").glob("*.mp4"))) == 3
    # Every environment replans after the 5 steps of its plan.
    assert wm_policy.plans and {plan["slot"] for plan in wm_policy.plans} <= set(range(8))


def test_infos_have_one_row_per_environment():
    world = swm.World("swm/PushT-v1", num_envs=8, image_shape=(64, 64))
    world.reset(seed=0)
    assert world.infos["pixels"].shape == (8, 1, 64, 64, 3)


def test_collected_episodes_have_sampled_and_pinned_factors(tmp_path):
    world = swm.World("swm/PushT-v1", num_envs=2, image_shape=(32, 32), max_episode_steps=5)
    your_policy = swm.policy.RandomPolicy(seed=0)
    world.set_policy(your_policy)
    world.collect(
        tmp_path / "data/pusht_demo.h5",
        episodes=4,
        options={
            "variation": ["agent.color", "block.scale"],
            "variation_values": {
                "background.color": [0.1, 0.2, 0.9]  # fix specific value
            },
        },
    )
    data = swm.data.load_dataset(str(tmp_path / "data/pusht_demo.h5"), backend="numpy")
    first = {key: data.get_col_data(key)[::6] for key in data.column_names if key.startswith("variation.")}
    assert (first["variation.background.color"] == [26, 51, 230]).all()
    assert len(np.unique(first["variation.agent.color"], axis=0)) > 1
    assert len(np.unique(first["variation.block.scale"])) > 1
    metrics = world.evaluate(policy=your_policy, options={"variation": ["all"]}, episodes=4)
    assert len(metrics["episode_successes"]) == 4


def test_visual_wrappers_change_only_frames_on_atari():
    pytest.importorskip("ale_py")
    world, plain = (
        swm.World("ALE/Pong-v5", num_envs=2, image_shape=(84, 84), extra_wrappers=wrappers)
        for wrappers in (
            [
                partial(NoiseWrapper, std=8.0),
                partial(ColorJitterWrapper, brightness=0.3, hue=0.1),
                partial(OcclusionWrapper, num_patches=2, size=(0.1, 0.25)),
            ],
            [],
        )
    )
    for one in (world, plain):
        one.set_policy(swm.policy.RandomPolicy(seed=1))
        one.reset(seed=0)
        for _ in range(3):
            one.step()
    assert world.infos["pixels"].shape == (2, 1, 84, 84, 3)
    assert not np.array_equal(world.infos["pixels"], plain.infos["pixels"])
    # The wrappers do not change the game.
    assert np.array_equal(world.infos["observation"], plain.infos["observation"])
    metrics = world.evaluate(episodes=2, eval_budget=5, seed=0)
    assert len(metrics["steps"]) == 2
    world.close()


class Straight:
    """A user-defined solver that returns the cheapest of five constant action sequences."""

    def __init__(self, model):
        self.model, self.calls = model, []

    def configure(self, *, action_space, n_envs, config):
        self.dim = int(np.prod(action_space.shape[1:])) * config.action_block
        self.n_envs, self.config = n_envs, config

    def solve(self, info_dict, init_action=None):
        envs = len(info_dict["state"])
        self.calls.append((envs, init_action))
        constant_actions = torch.linspace(-1, 1, 5)[:, None, None].expand(-1, self.config.horizon, self.dim)
        candidates = constant_actions[None].expand(envs, -1, -1, -1)
        infos = {key: value[:, None].expand(-1, 5, *value.shape[1:]) for key, value in info_dict.items()}
        best = self.model.get_cost(infos, candidates).argmin(1)
        return {"actions": candidates[torch.arange(envs), best]}


class Rightward:
    """A model whose cost has its minimum at the action (1, 1)."""

    def get_cost(self, info_dict, action_candidates):
        return ((action_candidates - 1) ** 2).sum((2, 3))


def test_user_defined_solver_plans():
    solver = Straight(Rightward())
    world = swm.World("swm/TwoRoom-v1", num_envs=3, image_shape=(32, 32), max_episode_steps=10)
    policy = swm.policy.MPCPolicy(solver, config=swm.PlanConfig(horizon=4, receding_horizon=2, action_block=2))
    world.set_policy(policy)
    assert solver.n_envs == 3 and solver.dim == 4
    world.reset(seed=0)
    for _ in range(5):
        world.step()
        assert (world.infos["action"] == 1).all()
    # The second plan starts from the unexecuted part of the first plan.
    assert [envs for envs, _ in solver.calls] == [3, 3]
    assert solver.calls[0][1] is None and solver.calls[1][1].shape == (3, 2, 4)
    metrics = world.evaluate(episodes=4, seed=1, progress=False)
    assert len(metrics["episode_successes"]) == 4


def test_user_defined_format_is_collected_and_read(tmp_path):
    class Npz:
        """Writes one file for each episode."""

        def __init__(self, folder):
            self.folder, self.count = folder, 0

        def __enter__(self):
            self.folder.mkdir(parents=True)
            return self

        def __exit__(self, *exc):
            pass

        def write_episode(self, ep_data):
            np.savez(self.folder / f"{self.count:05}.npz", **{key: np.asarray(value) for key, value in ep_data.items()})
            self.count += 1

        def write_episodes(self, episodes):
            for episode in episodes:
                self.write_episode(episode)

    class NpzDataset(swm.data.Dataset):
        def __init__(self, folder, **kwargs):
            self.files = sorted(Path(folder).glob("*.npz"))
            self.episodes = [dict(np.load(file)) for file in self.files]
            lengths = np.array([len(episode["action"]) for episode in self.episodes])
            super().__init__(lengths, np.concatenate([[0], lengths.cumsum()[:-1]]), **kwargs)

        @property
        def column_names(self):
            return list(self.episodes[0])

        def _load_slice(self, ep_idx, start, end):
            rows = {key: torch.from_numpy(value[start:end]) for key, value in self.episodes[ep_idx].items()}
            return {**rows, "pixels": rows["pixels"].permute(0, 3, 1, 2)}

    @swm.data.register_format
    class NpzFormat(swm.data.Format):
        name = "npz-of-mine"

        @classmethod
        def detect(cls, path):
            return str(path).endswith(".npzs")

        @classmethod
        def open_reader(cls, path, **kwargs):
            return NpzDataset(path, **kwargs)

        @classmethod
        def open_writer(cls, path, **kwargs):
            return Npz(path)

    try:
        world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16), max_episode_steps=6)
        world.set_policy(swm.policy.RandomPolicy(seed=0))
        outcome = world.collect(tmp_path / "mine.npzs", episodes=3, seed=5, format="npz-of-mine")
        assert outcome["episodes"] == 3 and len(list((tmp_path / "mine.npzs").iterdir())) == 3
        mine = swm.data.load_dataset(str(tmp_path / "mine.npzs"), num_steps=2)
        world.collect(tmp_path / "plain.lance", episodes=3, seed=5)
        plain = swm.data.load_dataset(str(tmp_path / "plain.lance"), num_steps=2)
        assert len(mine) == len(plain)
        for i in (0, len(mine) - 1):
            for key in ("pixels", "state"):
                assert np.array_equal(mine[i][key], plain[i][key]), key
    finally:
        swm.data.FORMATS.pop("npz-of-mine", None)


class Corridor(gymnasium.Env):
    """A dot on a line; its colour and speed are factors of variation."""

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(self, render_mode=None, length=10.0, title=None):
        self.render_mode, self.length, self.title = render_mode, float(length), title
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        self.variation_space = swm.spaces.Dict(
            {
                "agent": swm.spaces.Dict(
                    {
                        "color": swm.spaces.RGBBox(init_value=np.array([255, 0, 0], np.uint8)),
                        "speed": swm.spaces.Box(0.1, 2.0, shape=(1,), init_value=np.array([1.0], np.float32)),
                    }
                ),
                "start": swm.spaces.Discrete(3, init_value=0),
            }
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        swm.spaces.reset_variation_space(self.variation_space, seed, options)
        self.x = float(self.variation_space.value["start"])
        return self._observed(), self._info()

    def step(self, action):
        speed = float(self.variation_space.value["agent"]["speed"][0])
        self.x = float(np.clip(self.x + speed * float(action[0]), -self.length, self.length))
        done = self.x >= 5
        return self._observed(), -abs(5 - self.x), done, False, self._info()

    def render(self):
        image = np.zeros((32, 32, 3), np.uint8)
        at = int((self.x + self.length) / (2 * self.length) * 27)
        image[14:18, at : at + 4] = self.variation_space.value["agent"]["color"]
        return image

    def _observed(self):
        return np.array([self.x, 5], np.float32)

    def _info(self):
        return {"place": self.x, "success": self.x >= 5, "goal_distance": abs(5 - self.x)}


@pytest.fixture
def corridor():
    gymnasium.register("Corridor-v0", entry_point=Corridor, max_episode_steps=8)
    yield "Corridor-v0"
    gymnasium.registry.pop("Corridor-v0")


class Forward(swm.policy.BasePolicy):
    def get_action(self, infos, **kwargs):
        return np.ones(self.env.action_space.shape, np.float32)


def test_user_defined_environment_is_collected_and_evaluated(tmp_path, corridor):
    world = swm.World(corridor, num_envs=3, image_shape=(32, 32), length=12)
    assert world.variation_space.names() == ["agent.color", "agent.speed", "start"]
    assert world.max_episode_steps == 8 and world.gym_envs[0].unwrapped.length == 12
    world.set_policy(Forward())
    world.reset(seed=0, options={"variation": ["agent.color"], "variation_values": {"start": 2, "agent.speed": [0.5]}})
    assert (world.infos["place"] == 2).all() and world.infos["observation"].shape == (3, 1, 2)
    colours = {tuple(world.factors(i)["agent.color"]) for i in range(3)}
    assert len(colours) == 3 and world.factors(0)["agent.speed"] == [0.5]
    shown = {tuple(world.infos["pixels"][i, 0].reshape(-1, 3).max(0).tolist()) for i in range(3)}
    assert shown == {tuple(int(n) for n in colour) for colour in colours}
    world.step()
    assert np.allclose(world.infos["place"], 2.5) and np.allclose(world.rewards, -2.5)
    world.collect(tmp_path / "c.lance", episodes=4, seed=3, options={"variation": ["start"]})
    data = swm.data.load_dataset(str(tmp_path / "c.lance"), backend="numpy")
    starts = np.array([data.load_episode(e)["variation.start"].ravel()[0] for e in range(4)])
    places = np.array([data.load_episode(e)["place"].ravel()[0] for e in range(4)])
    assert np.array_equal(starts, places)
    metrics = world.evaluate(episodes=4, seed=0, options={"variation_values": {"start": 0}}, floor=False)
    assert metrics["success_rate"] == 100 and metrics["steps"].tolist() == [5] * 4
    with pytest.raises(ValueError, match=r"agent\.velocity.*swm fovs"):
        world.reset(options={"variation": ["agent.velocity"]})


def test_user_defined_wrapper_changes_frames_and_rewards(corridor):
    class Negative(gymnasium.Wrapper):
        def __init__(self, env, offset=0):
            super().__init__(env)
            self.offset = offset

        def render(self):
            return 255 - self.env.render()

        def step(self, action):
            observation, reward, *rest = self.env.step(action)
            return observation, reward + self.offset, *rest

    world = swm.World(corridor, num_envs=2, image_shape=(32, 32), extra_wrappers=[partial(Negative, offset=10)])
    world.set_policy(Forward())
    world.reset(seed=0)
    assert world.infos["pixels"].max() == 255 and np.median(world.infos["pixels"]) == 255
    world.step()
    assert np.allclose(world.rewards, 6)
    # Around a native environment, mixed with a visual wrapper.
    mixed = swm.World(
        "swm/TwoRoom-v1", num_envs=2, image_shape=(32, 32), extra_wrappers=[Negative, partial(NoiseWrapper, std=4.0)]
    )
    plain = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(32, 32))
    for one in (mixed, plain):
        one.reset(seed=[5, 6])
    assert np.array_equal(mixed.infos["state"], plain.infos["state"])
    difference = np.abs(255.0 - mixed.infos["pixels"] - plain.infos["pixels"])
    assert 1 < difference.mean() < 6


@pytest.mark.parametrize("title", ["5", "true", "None", "(1, 2)", "a,b", "it's", "4x4"])
def test_options_that_are_texts_stay_texts(corridor, title):
    with swm.World(corridor, image_shape=(32, 32), title=title) as world:
        assert world.gym_envs[0].unwrapped.title == title
