"""Tests of what the manifests of datasets and results record of policies and environments, and of what is therefore refused."""

import copy
import functools
import io
import json
import os
import pickle
import random
import re
import shutil
import socket
import subprocess
import sys
import weakref
from collections import deque
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel.policy import ExpertPolicy, FeedForwardPolicy, MPCPolicy, RandomPolicy
from stable_worldmodel.wrapper.visual import GrayscaleWrapper, NoiseWrapper

#: The program; by default the one of the installed package.
PROGRAM = [os.environ["SWM"]] if "SWM" in os.environ else [sys.executable, "-m", "stable_worldmodel"]


def rooms(**more):
    return swm.World("swm/TwoRoom-v1", **{"num_envs": 2, "image_shape": (32, 32), "max_episode_steps": 6, **more})


def manifest(path):
    return swm.data.load_dataset(path).manifest


def collected(path, policy, episodes=2, world=None, **more):
    with world or rooms() as opened:
        return opened.collect(path, policy=policy, episodes=episodes, seed=3, progress=False, **more)


def refused(path, policy, words, world=None, mode="resume", **more):
    """Checks that nothing continues a dataset, and that it stays as it is."""
    before = manifest(path)
    with pytest.raises(ValueError, match=words):
        collected(path, policy, 4, world, mode=mode, **more)
    assert manifest(path) == before and len(swm.data.load_dataset(path).lengths) == 2


def command(*words):
    done = subprocess.run([*PROGRAM, *map(str, words)], capture_output=True, text=True, timeout=120)
    return done.returncode, done.stdout + done.stderr


def page(folder, *results):
    """The text of a report without figures."""
    code, words = command("report", *results, "--output", folder)
    assert code == 0, words
    return (folder / "index.html").read_text()


# Policies.


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory):
    """Two checkpoints of the engine that act, trained with other seeds."""
    folder = tmp_path_factory.mktemp("checkpoints")
    collected(folder / "d.lance", ExpertPolicy(), 12, rooms(image_shape=(64, 64), max_episode_steps=40))
    for seed in (0, 1):
        given = {"schedule__steps": 2, "data__batch_size": 4, "seed": seed}
        swm.wm.train("gcbc", data=str(folder / "d.lance"), out=str(folder / f"gcbc-{seed}"), **given)
    return [str(folder / f"gcbc-{seed}") for seed in (0, 1)]


def torch_modules():
    """Models in PyTorch, which act and can be planned with."""
    torch = pytest.importorskip("torch")

    class Linear(torch.nn.Module):
        def __init__(self, seed):
            super().__init__()
            torch.manual_seed(seed)
            self.linear = torch.nn.Linear(2, 2)

        def get_action(self, infos):
            return torch.tanh(self.linear(torch.as_tensor(infos["state"])[:, 0, :2].float()))

        def get_cost(self, infos, candidates):
            return self.linear(candidates[..., :2]).square().sum((-1, -2))

    return Linear


def test_a_torch_module_continues_only_the_dataset_of_its_weights(tmp_path):
    Linear = torch_modules()

    def planner(model):
        solver = swm.planning.CEMSolver(model, num_samples=8, n_steps=1, topk=2)
        return MPCPolicy(solver, config=swm.PlanConfig(horizon=2, receding_horizon=1, action_block=1))

    class Mine(swm.policy.BasePolicy):
        def __init__(self, model):
            super().__init__(model=model)

        def get_action(self, infos, **named):
            return self.model.get_action(infos).detach().numpy()

    for name, make in (("feed_forward", FeedForwardPolicy), ("world_model", planner), ("Mine", Mine)):
        path = tmp_path / f"{name}.h5"
        collected(path, make(Linear(0)))
        recorded = manifest(path)
        assert re.match(rf"{name},.*weights=torch-sha256-\w{{64}}$", recorded["config"]["policy"]) and recorded["hashes"] == {}
        for mode in ("resume", "append"):
            words = f"mode='{mode}'.*weights=torch-sha256-.*; they differ in their weights; for a policy that learns"
            refused(path, make(Linear(1)), words, mode=mode)
        assert collected(path, make(Linear(0)), 4, mode="resume")["added"] == 2
        assert collected(path, make(Linear(0)), 1, mode="append")["added"] == 1


def test_a_policy_that_learns_appends_to_the_dataset_that_it_began(tmp_path):
    torch = pytest.importorskip("torch")

    class Learner(swm.policy.BasePolicy):
        def __init__(self):
            super().__init__(net=torch.nn.LazyLinear(2))

        def get_action(self, infos, **named):
            return self.net(torch.as_tensor(infos["state"][:, 0, :2].copy()).float()).detach().numpy()

    policy, path = Learner(), tmp_path / "d.h5"
    for episodes in (2, 4, 6):
        assert collected(path, policy, 2, mode="append")["episodes"] == episodes
        with torch.no_grad():
            policy.net.weight.add_(1)
    assert manifest(path)["config"]["policy"] == "Learner"
    assert collected(path, policy, 8, mode="resume")["added"] == 2
    path = tmp_path / "named"
    collected(path, RandomPolicy(type="mine"), format="hdf5")
    assert collected(path, RandomPolicy(type="mine"), 1, format="hdf5", mode="append")["added"] == 1


def test_modules_are_found_wherever_a_policy_holds_them():
    torch = pytest.importorskip("torch")
    from stable_worldmodel.world.settings import Unrecorded, modules_hash

    class Slots:
        __slots__ = ("net", "other")

        def __init__(self, net):
            self.net = net

    holders = {
        "closure": lambda net: lambda infos: net(infos),
        "method": lambda net: net.forward,
        "partial": lambda net: functools.partial(map, net),
        "depth": lambda net: {"a": [{"b": ({1: {"c": net}},)}]},
        "length": lambda net: [*range(100), [None] * 100, net],
        "slots": Slots,
        "array": lambda net: np.array([net, None], dtype=object),
    }
    torch.manual_seed(0)
    first, other = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    for name, hold in holders.items():
        found = [modules_hash(swm.policy.BasePolicy(held=hold(net))) for net in (first, first, other)]
        assert found[0] == found[1] != found[2] and found[0].startswith("torch-sha256-"), name
    # A buffer of transitions is searched in its first entries only.
    found = []
    for length in (10, 100_000):
        buffer = deque([(np.zeros(2), 1.0, False)] * 3 + [(i,) for i in range(length)])
        found.append(modules_hash(swm.policy.BasePolicy(net=first, buffer=buffer)))
    assert found[0] == found[1] is not None

    def made(net):
        class Mine(swm.policy.BasePolicy):
            def get_action(self, infos, **named):
                return net(infos)

        return Mine()

    class Shared(swm.policy.BasePolicy):
        net = first

    found = [modules_hash(policy) for policy in (made(first), made(first), made(other), Shared())]
    assert found[0] == found[1] != found[2] and None not in found
    for held, words in (({first}, "a set"), ([[[] for _ in range(200)] for _ in range(200)], "more than 20000 objects")):
        with pytest.raises(Unrecorded, match=words):
            modules_hash(swm.policy.BasePolicy(held=held))
    endless = swm.policy.BasePolicy()
    endless.itself = endless
    assert modules_hash(endless) is None


class OwnPlanner(MPCPolicy):
    """A policy of the user that shares no code with its base class."""

    def __init__(self):
        self.env = None

    def set_env(self, env):
        self.env = env

    def get_action(self, infos, **named):
        return np.zeros((2, 2), np.float32)


class OwnModel(FeedForwardPolicy):
    """Acts without the checkpoint that its text seems to name."""

    def get_action(self, infos, **named):
        return np.zeros((2, 2), np.float32)


class NoText:
    def __str__(self):
        raise RuntimeError("no text")


def test_a_policy_that_cannot_be_recorded_is_evaluated(checkpoints, tmp_path, monkeypatch):
    for policy in (OwnPlanner(), OwnModel("my-net"), swm.policy.BasePolicy(given={NoText(): 1})):
        policy.get_action = functools.partial(OwnPlanner.get_action, policy)
        entry = evaluated(tmp_path, policy, episodes=2)["config"]["policies"][-1]
        assert "unrecorded" not in entry["acts"]["python"]
        path = tmp_path / f"{type(policy).__name__}.h5"
        for episodes in (2, 4):
            assert collected(path, policy, episodes, mode="resume")["added"] == 2
    # The weights are those that the engine loaded, whatever a description says.
    small = functools.partial(rooms, image_shape=(64, 64), max_episode_steps=5)
    model = swm.wm.load(checkpoints[0])
    weights, model.card["weights"] = model.card["weights"], None

    def fails(*_):
        raise OSError("removed")

    monkeypatch.setattr(swm.world.records, "_checkpoint_hash", fails)
    for given in (model, checkpoints[0]):
        assert list(evaluated(tmp_path, FeedForwardPolicy(given), small(), 2)["hashes"].values()) == [weights]
    # A checkpoint of a policy is removed while it acts.
    mixture = swm.policy.MixturePolicy({"random": 1, checkpoints[0]: 1})
    found = evaluated(tmp_path, mixture, small(), 2)
    acts = found["config"]["policies"][-1]["acts"]
    assert "mixture" in acts and "OSError: removed" in json.dumps(acts) and found["hashes"] == {}


def test_a_checkpoint_and_its_torch_module_do_not_continue_each_other(checkpoints, tmp_path):
    pytest.importorskip("torch")
    first, other = checkpoints
    path, big = tmp_path / "d.h5", functools.partial(rooms, image_shape=(64, 64))
    collected(path, FeedForwardPolicy(first), world=big())
    assert manifest(path)["config"]["policy"] == "feed_forward" and list(manifest(path)["hashes"]) == ["policy"]
    for name in (first, other):
        refused(path, FeedForwardPolicy(swm.wm.load_pretrained(name)), "continuing a collection with policy", big())
    refused(path, FeedForwardPolicy(other), "the weights of policy", big())
    assert collected(path, FeedForwardPolicy(swm.wm.load(first)), 4, big(), mode="resume")["added"] == 2
    path = tmp_path / "torch.h5"
    collected(path, FeedForwardPolicy(swm.wm.load_pretrained(first)), world=big())
    refused(path, FeedForwardPolicy(first), "its episodes were collected with policy .*torch-sha256", big())


@pytest.mark.parametrize(
    "change",
    [
        {"horizon": 4},
        {"warm_start": False},
        {"num_samples": 12},
        {"seed": 1},
        {"kind": "ICEMSolver"},
    ],
)
def test_another_plan_continues_no_dataset(change, tmp_path):
    def planner(kind="CEMSolver", num_samples=8, seed=0, horizon=3, **plan):
        solver = getattr(swm.solver, kind)("simulator", num_samples=num_samples, n_steps=1, topk=6, seed=seed)
        return MPCPolicy(solver, config=swm.PlanConfig(horizon=horizon, receding_horizon=1, action_block=2, **plan))

    path = tmp_path / "d.h5"
    collected(path, planner())
    words = manifest(path)["config"]["policy"].split(",")
    assert words[0] == "world_model" and {"model=simulator", "plan.horizon=3", "seed=0", "solver=cem"} < set(words)
    refused(path, planner(**change), "its episodes were collected with policy .*plan.horizon=3")
    assert collected(path, planner(), 4, mode="resume")["added"] == 2


def test_names_of_policies_of_the_engine_are_its_own(tmp_path):
    def still(name, base=swm.policy.BasePolicy, kind=None):
        def get_action(self, infos, **named):
            return np.zeros((2, 2), np.float32)

        return type(name, (base,), {"get_action": get_action, **({} if kind is None else {"type": kind})})()

    class Fast(ExpertPolicy):
        pass

    path = tmp_path / "d.h5"
    for kind in ("random", "expert", "explore", "no-op", "feed_forward"):
        collected(path, still("Still", kind=kind), mode="overwrite")
        assert manifest(path)["config"]["policy"] == "Still"
    refused(path, RandomPolicy(), 'its episodes were collected with policy "Still"')
    code, words = command("collect", "--resume", "--output", path, "--episodes", "4")
    assert code != 0 and "Still" in words
    for policy, name in (
        (still("random"), f"{__name__}.random"),
        (still("Still", ExpertPolicy), "Still"),
        (RandomPolicy(type="expert"), "RandomPolicy,kind=random"),
        (still("Still", kind="standing"), "standing"),
        (Fast(), "expert"),
        (RandomPolicy(), "random"),
        (RandomPolicy(type="mine"), "mine"),
    ):
        collected(path, policy, mode="overwrite")
        assert manifest(path)["config"]["policy"] == name
    with rooms() as world:
        metrics = world.evaluate(policy=still("Still", kind="random"), episodes=2, seed=0, progress=False)
    assert [run["policy"] for run in metrics.results["runs"]] == ["random", "Still"] and "random_success_rate" in metrics


# Environments.


def test_equal_settings_have_equal_descriptions():
    def scaler(*values):
        scaler = swm.data.normalization.ZScoreScaler(np.array(values), np.ones(len(values)))
        return {"action": scaler, "other": functools.partial(np.clip, a_min=values[0])}

    described = swm.world.settings.described
    assert described(scaler(1.0, 2.0)) == described(scaler(1.0, 2.0)) != described(scaler(1.0, 3.0))
    assert described(np.arange(99)) == described(np.arange(99)) != described(np.arange(1, 100))
    one, same, other = (lambda frame: frame * 2), (lambda frame: frame * 2), (lambda frame: frame * 3)
    assert described(one) == described(same) != described(other)
    code = "from stable_worldmodel.world.settings import described; print(described(lambda x: x in {'a', 'b', 'c', 'd'}))"
    texts = {
        subprocess.run(
            [sys.executable, "-c", code], env={**os.environ, "PYTHONHASHSEED": seed}, capture_output=True, check=True
        ).stdout
        for seed in "123"
    }
    assert len(texts) == 1
    nested: list = []
    nested.append(nested)
    many = [[0] * 100] * 101
    generators = np.random.default_rng(0), random.Random(0)
    for unrecorded in (*generators, object(), nested, many, {1: 0, "1": 0}, sys.stdout, io.StringIO(), socket.socket()):
        with pytest.raises(swm.world.settings.Unrecorded):
            described({"value": unrecorded})
    assert described({1: 0, ("a", 2): 1, len: 2}) == {"1": 0, '["a",2]': 1, '"builtins.len"': 2}
    assert described(b"some bytes") == described(b"some bytes") != described(b"same bytes")
    assert described(Path("a/b")) == "a/b"


LEVEL = 2


def test_functions_have_the_plain_values_that_they_read_from_their_module(monkeypatch):
    def frame(value):
        return [part * LEVEL for part in value]

    described = swm.world.settings.described
    before = described(frame)
    assert before["globals"] == {"LEVEL": 2} and described(frame) == before
    monkeypatch.setattr(sys.modules[__name__], "LEVEL", 3)
    assert described(frame) != before


def test_a_description_leaves_files_and_finalizers_as_they_are(tmp_path):
    class Kept:
        pass

    kept, ended = Kept(), []
    finalizer = weakref.finalize(kept, ended.append, 1)
    with (tmp_path / "log").open("w") as log:
        for given in (log, log.buffer, finalizer):
            with pytest.raises(swm.world.settings.Unrecorded):
                swm.world.settings.named("it", given)
        log.write("written")
    assert (tmp_path / "log").read_text() == "written" and finalizer.alive and not ended


class Scaled(gymnasium.ActionWrapper):
    """Scales actions."""

    def __init__(self, env, factor=-1.0):
        super().__init__(env)
        self.factor = factor

    def action(self, action):
        return np.asarray(action) * self.factor


def scaled(env):
    return Scaled(env, 0.5)


@pytest.mark.parametrize("env", ["swm/TwoRoom-v1", "Pendulum-v1"])
def test_wrappers_in_python_are_recorded_and_compared(env, tmp_path):
    def world(*wrappers):
        return swm.World(env, num_envs=1, image_shape=(32, 32), max_episode_steps=6, extra_wrappers=wrappers)

    path = tmp_path / "d.h5"
    half = functools.partial(Scaled, factor=0.5)
    for wrappers, again, others in (
        ([Scaled], [Scaled], ([], [half], [Scaled, Scaled], [scaled])),
        ([half], [functools.partial(Scaled, factor=0.5)], ([], [Scaled], [functools.partial(half, factor=0.25)])),
        ([scaled], [scaled], ([Scaled], [lambda env: Scaled(env, 0.25)])),
        ([], [], ([Scaled],)),
    ):
        collected(path, RandomPolicy(), world=world(*wrappers), mode="overwrite")
        recorded = manifest(path)["config"]["wrappers"]
        assert [wrapper["id"].split(".")[-1].lower() for wrapper in recorded] == ["scaled"] * len(wrappers)
        for other in others:
            refused(path, RandomPolicy(), "continuing a collection with wrappers", world(*other))
        assert collected(path, RandomPolicy(), 3, world(*again), mode="resume")["added"] == 1
    collected(path, RandomPolicy(), world=world(Scaled), mode="overwrite")
    code, words = command("collect", "--resume", "--output", path, "--episodes", "4")
    assert code != 0 and f"python:{__name__}.Scaled" in words


class Told(gymnasium.Wrapper):
    """Writes rewards to a file or a list."""

    def __init__(self, env, to):
        super().__init__(env)
        self.to = to

    def step(self, action):
        result = self.env.step(action)
        self.to(f"{result[1]}\n")
        return result


class Clipped(gymnasium.ActionWrapper):
    def __init__(self, env, space):
        super().__init__(env)
        self.action_space = space

    def action(self, action):
        return action


def test_wrappers_that_log_or_have_a_space_are_continued(tmp_path):
    def own():
        return type("Own", (swm.policy.BasePolicy,), {"get_action": lambda self, infos: np.zeros((2, 2), np.float32)})()

    log: list = []
    with rooms(extra_wrappers=[lambda env: Told(env, log.append)]) as world:
        for episodes in (2, 4, 6):
            done = world.collect(tmp_path / "log.h5", policy=RandomPolicy(), episodes=2, seed=3, progress=False, mode="append")
            assert done["episodes"] == episodes
    for sampled in (False, True):
        space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        if sampled:
            space.sample()
        world = rooms(extra_wrappers=[functools.partial(Clipped, space=space)])
        assert collected(tmp_path / "space.h5", RandomPolicy(), 2, world, mode="append")["added"] == 2
    space = gymnasium.spaces.Box(-2, 1, (2,), np.float32)
    with pytest.raises(ValueError, match="continuing a collection with wrappers"):
        collected(
            tmp_path / "space.h5",
            RandomPolicy(),
            2,
            rooms(extra_wrappers=[functools.partial(Clipped, space=space)]),
            mode="append",
        )

    class Counted:
        def __init__(self):
            self.count = 0

        def __call__(self, frame):
            self.count += 1
            return np.asarray(frame)

    with rooms(image_transform=Counted()) as world:
        for episodes in (2, 4):
            done = world.collect(tmp_path / "n.h5", policy=own(), episodes=episodes, seed=3, progress=False, mode="resume")
            assert done["added"] == 2
    with (tmp_path / "rewards").open("w") as opened:

        def world():
            return rooms(extra_wrappers=[functools.partial(Told, to=opened.write)])

        collected(tmp_path / "file.h5", RandomPolicy(), world=world())
        refused(tmp_path / "file.h5", RandomPolicy(), "cannot be recorded: .*TextIOWrapper", world())
        assert evaluated(tmp_path, RandomPolicy(), world(), 2)["config"]["wrappers"][0]["settings"].keys() == {"unrecorded"}
    assert len((tmp_path / "rewards").read_text()) > 40


def test_a_collection_into_a_buffer_describes_nothing(tmp_path, monkeypatch):
    def fails(*_, **__):
        raise AssertionError("described")

    for name in ("policy_settings", "weights_hash", "named", "modules_hash"):
        monkeypatch.setattr(swm.world.records, name, fails)
    buffer = swm.data.ReplayBuffer(100)
    for _ in range(2):
        world = rooms(extra_wrappers=[Scaled], image_transform=np.asarray)
        assert collected(None, RandomPolicy(), world=world, writer=buffer)["added"] == 2


def test_long_settings_of_wrappers_are_recorded_by_their_hash(tmp_path):
    path, sizes = tmp_path / "d.h5", []
    for length in (2_000, 2_001):
        names = {f"name {index}": index for index in range(length)}
        world = rooms(extra_wrappers=[functools.partial(Told, to=functools.partial(print, *names, end=""))])
        if sizes:
            refused(path, RandomPolicy(), "continuing a collection with wrappers", world)
        else:
            collected(path, RandomPolicy(), world=world)
        sizes.append(len(json.dumps(manifest(path))))
    assert sizes[0] < 2_000


def test_wrappers_whose_settings_cannot_be_recorded_are_not_continued(tmp_path):
    path, generator = tmp_path / "d.h5", np.random.default_rng(0)

    def world():
        return rooms(extra_wrappers=[lambda env: Scaled(env, generator.uniform())])

    assert collected(path, RandomPolicy(), world=world(), mode="resume")["added"] == 2
    for mode in ("resume", "append"):
        refused(path, RandomPolicy(), f"mode='{mode}' .*cannot be recorded: .*Generator.*functools.partial", world(), mode)
    refused(path, RandomPolicy(), "continuing a collection with wrappers")
    buffer = swm.data.ReplayBuffer(100)
    assert collected(None, RandomPolicy(), world=world(), writer=buffer)["added"] == 2


class Pixels(gymnasium.Env):
    """Has a frame of random pixels."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(3)
    metadata = {"render_modes": ["rgb_array"]}
    render_mode = "rgb_array"
    frame = np.random.default_rng(0).integers(0, 255, (50, 70, 3), dtype=np.uint8)

    def __init__(self, render_mode="rgb_array"):
        pass

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, False, False, {}

    def render(self):
        return self.frame


def test_settings_of_frames_are_recorded_and_compared(tmp_path):
    name, path = "Pixels-v0", tmp_path / "d.h5"
    gymnasium.register(name, Pixels)
    try:

        def pixels(resample):
            return swm.World(name, image_shape=(10, 14), max_episode_steps=3, image_resample=resample)

        for first, others in (("nearest", ("bilinear", None)), (None, ("nearest",))):
            collected(path, RandomPolicy(), world=pixels(first), mode="overwrite")
            for other in others:
                refused(path, RandomPolicy(), "image_resample.*nearest", pixels(other))
            # That of the environment is `bilinear`.
            again = first or "bilinear"
            assert collected(path, RandomPolicy(), 3, pixels(again), mode="resume")["added"] == 1
    finally:
        del gymnasium.registry[name]
    noise = [functools.partial(NoiseWrapper, std=30)]
    collected(path, RandomPolicy(), world=rooms(extra_wrappers=noise, wrap_goal=True), mode="overwrite", goal=True)
    refused(path, RandomPolicy(), "wrap_goal", rooms(extra_wrappers=noise), goal=True)
    # Without wrappers it has no effect.
    with pytest.warns(UserWarning, match="wrap_goal: there are no wrappers"):
        collected(path, RandomPolicy(), world=rooms(wrap_goal=True), mode="overwrite", goal=True)
    assert collected(path, RandomPolicy(), 3, mode="resume", goal=True)["added"] == 1


def test_torch_modules_are_described_by_their_own_settings_without_addresses():
    torch = pytest.importorskip("torch")
    from stable_worldmodel.world.settings import described

    class Scaled(torch.nn.Module):
        def __init__(self, scale, function):
            super().__init__()
            self._scale, self.function, self._open = scale, function, io.StringIO()

        def extra_repr(self):
            return repr(self.function)

    def made(scale, offset):
        return described(Scaled(scale, lambda x: x + offset))

    assert made(1.0, 2) == made(1.0, 2)
    assert made(1.0, 2) not in (made(255.0, 2), made(1.0, 3))
    assert "0x" not in json.dumps(made(1.0, 2))


def test_transforms_of_frames_are_recorded_for_policies_that_get_them(checkpoints, tmp_path):
    path, policy = tmp_path / "d.h5", FeedForwardPolicy(checkpoints[0])

    def world(level):
        return rooms(image_shape=(64, 64), image_transform=lambda frame: np.asarray(frame) // level)

    collected(path, policy, world=world(2))
    assert "weights=" in manifest(path)["config"]["policy"]
    refused(path, FeedForwardPolicy(checkpoints[0]), "image_transform", world(3))
    refused(path, FeedForwardPolicy(checkpoints[1]), "weights=", world(2))
    refused(path, FeedForwardPolicy(checkpoints[0]), "continuing a collection with", rooms(image_shape=(64, 64)))
    assert collected(path, FeedForwardPolicy(checkpoints[0]), 3, world(2), mode="resume")["added"] == 1
    collected(path, RandomPolicy(), world=world(2), mode="overwrite")
    assert manifest(path)["config"]["wrappers"] == []


# Results.


def evaluated(path, policy, world=None, episodes=6, **more):
    with world or rooms(max_episode_steps=60) as opened:
        metrics = opened.evaluate(policy=policy, episodes=episodes, seed=1, progress=False, **more)
    metrics.save(path / "results.json")
    return json.loads((path / "results.json").read_text())["manifest"]


SHIFT = {"options": {"variation_values": {"background.color": [250, 250, 255]}}}


def test_results_of_other_policies_have_no_gap(checkpoints, tmp_path):
    def planner(samples):
        solver = swm.solver.CEMSolver("simulator", num_samples=samples, n_steps=1, topk=2)
        return MPCPolicy(solver, config=swm.PlanConfig(horizon=2, receding_horizon=1, action_block=5))

    small = functools.partial(rooms, image_shape=(64, 64), max_episode_steps=20)
    for name, same, other in (
        ("plan", planner(16), planner(8)),
        ("weights", *map(FeedForwardPolicy, checkpoints)),
    ):
        folder = tmp_path / name
        plain = evaluated(folder / "plain", same, small())
        shifted = evaluated(folder / "shifted", same, small(), **SHIFT)
        others = evaluated(folder / "others", other, small(), **SHIFT)
        assert "Generalisation gap" in page(folder / "page", folder / "plain", folder / "shifted")
        assert "Generalisation gap" not in page(folder / "page", folder / "plain", folder / "others")
        identity = [(found["config"]["policies"], found["hashes"]) for found in (plain, shifted, others)]
        assert identity[0] == identity[1] != identity[2]
    assert list(plain["hashes"]) == ["weights of feed_forward"]
    assert plain["config"]["policies"][0] == {"name": "random", "acts": "random"}


def test_results_have_the_hash_of_a_torch_module(tmp_path):
    Linear = torch_modules()
    hashes = [evaluated(tmp_path, FeedForwardPolicy(Linear(seed)), episodes=2)["hashes"] for seed in (0, 0, 1)]
    assert hashes[0] == hashes[1] != hashes[2]
    assert hashes[0]["weights of feed_forward"].startswith("torch-sha256-")


def test_results_of_other_time_limits_and_wrappers_have_no_gap(tmp_path):
    plain = evaluated(tmp_path / "plain", ExpertPolicy())["config"]
    assert (plain["budget"], plain["image"], plain["wrappers"], plain["wrap_goal"]) == (60, [32, 32], [], False)
    assert plain["starts"] == "episodic" and plain["policies"][1] == {"name": "expert", "acts": {"expert": {"id": "expert"}}}
    evaluated(tmp_path / "short", ExpertPolicy(), rooms(max_episode_steps=25), **SHIFT)
    evaluated(tmp_path / "budget", ExpertPolicy(), eval_budget=25, **SHIFT)
    # A shift of frames is a condition, as in `swm eval`; a wrapper in Python may change the task.
    noise = [functools.partial(NoiseWrapper, std=30), GrayscaleWrapper]
    noisy = evaluated(tmp_path / "noisy", ExpertPolicy(), rooms(max_episode_steps=60, extra_wrappers=noise))["config"]
    assert noisy["condition"] == "noise,std=30, grayscale" and [one["id"] for one in noisy["wrappers"]] == [
        "noise",
        "grayscale",
    ]
    wrapped = rooms(max_episode_steps=60, extra_wrappers=[functools.partial(gymnasium.wrappers.TransformReward, func=float)])
    evaluated(tmp_path / "wrapped", ExpertPolicy(), wrapped, **SHIFT)
    for name, has_gap in (("short", False), ("budget", False), ("noisy", True), ("wrapped", False)):
        assert ("Generalisation gap" in page(tmp_path / "page", tmp_path / "plain", tmp_path / name)) == has_gap, name


def test_results_have_the_hash_of_the_dataset_of_their_starts(tmp_path):
    data, found = tmp_path / "d.h5", []
    starts = {"dataset": data, "episodes_idx": [0, 1], "start_steps": [0, 0], "goal_offset": 3, "eval_budget": 5}
    for seed, name in ((0, "a"), (0, "b"), (9, "c")):
        with rooms() as world:
            world.collect(data, policy=RandomPolicy(), episodes=2, seed=seed, progress=False, mode="overwrite")
        shift = {} if name == "a" else SHIFT
        found.append(evaluated(tmp_path / name, RandomPolicy(seed=5), rooms(), None, **starts, **shift))
    hashes = [one["hashes"]["dataset"] for one in found]
    assert hashes[0] == hashes[1] != hashes[2] == swm.data.utils.inspect(data)["content_hash"]
    asked = {"dataset": str(data), "goal_offset": 3, "held_out": None}
    assert found[0]["config"]["starts"] == {"dataset": asked} and found[0]["config"]["budget"] == 5
    assert "goals 3 steps after starts of" in page(tmp_path / "page", tmp_path / "a", tmp_path / "c")


def test_the_hash_of_a_dataset_is_computed_again_after_a_change_only(tmp_path, monkeypatch):
    from stable_worldmodel.data import utils

    inspected, inspect = [], utils.inspect
    monkeypatch.setattr(utils, "inspect", lambda dataset: inspected.append(dataset) or inspect(dataset))
    data = tmp_path / "d.h5"
    starts = {"episodes_idx": [0, 1], "start_steps": [0, 0], "goal_offset": 3, "eval_budget": 5}
    found = []
    with rooms() as world:
        for seed, count in ((0, 1), (9, 2)):
            world.collect(data, policy=RandomPolicy(), episodes=2, seed=seed, progress=False, mode="overwrite")
            for dataset in (data, str(data), data.as_uri(), swm.data.load_dataset(data)):
                metrics = world.evaluate(policy=RandomPolicy(), dataset=dataset, seed=1, progress=False, **starts)
                found.append(metrics.results["manifest"]["hashes"]["dataset"])
                assert len(inspected) == count
    assert len(set(found[:4])) == len(set(found[4:])) == 1 and found[0] != found[4]


def test_videos_are_named_relative_to_the_results(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = ExpertPolicy(), RandomPolicy(1)
    with rooms() as world:
        given = {"episodes": 2, "progress": False}
        metrics = world.evaluate(policy=first, seed=0, video="results/videos", **given)
        other = world.evaluate(policy=second, seed=7, video="elsewhere", **given)
        metrics.save("results/a.json")
        other.save("results/b.json")
        for name, folder in (("a", "videos"), ("b", "../elsewhere")):
            runs = json.loads((tmp_path / f"results/{name}.json").read_text())["runs"]
            assert runs[-1]["videos"] == [f"{folder}/episode-{index}.mp4" for index in range(2)]
        assert page(tmp_path / "page", "results/a.json").count("<video") == 2
        text = page(tmp_path / "page", "results/b.json")
        assert "<video" not in text and "is outside the folder of its results file" in text
        # The next evaluation replaces the files.
        world.evaluate(policy=second, seed=9, video="results/videos", **given)
    with pytest.warns(UserWarning, match="episode-0.mp4, episode-1.mp4: these videos were replaced or moved since"):
        metrics.save("results/c.json")
    assert json.loads((tmp_path / "results/c.json").read_text())["runs"][-1]["videos"] == []


@pytest.fixture
def retrained(request, tmp_path):
    """A function that puts one of two trained models in the place of a checkpoint, and returns its path."""
    family, env = request.param
    with swm.World(env, 2, image_shape=(64, 64), max_episode_steps=30) as world:
        world.collect(tmp_path / "d.lance", policy=RandomPolicy(0), episodes=4, seed=0, progress=False)
    short = {"data": str(tmp_path / "d.lance"), "preset": "tiny", "schedule__steps": 1, "data__batch_size": 4}
    for seed in (0, 1):
        out, settings = str(tmp_path / f"model-{seed}"), {**short, "seed": seed}
        if family == "inverse":
            # The network stays the same: what changes is the world model whose latents it gets.
            swm.wm.train("lewm", out=f"{out}-encoder", **settings)
            encoder = ["--encoder", f"{out}-encoder", "--output", out]
            code, words = command(
                "train", "inverse", "--data", tmp_path / "d.lance", *encoder, "schedule.steps=1", "batch_size=4"
            )
            assert code == 0, words
        else:
            swm.wm.train(family, out=out, **settings)

    def put(seed):
        shutil.rmtree(tmp_path / "model", ignore_errors=True)
        shutil.copytree(tmp_path / f"model-{seed}", tmp_path / "model")
        return str(tmp_path / "model")

    put.env = env
    return put


@pytest.mark.parametrize(
    ("retrained", "kind"),
    [
        (("tdmpc2", "swm/PendulumControl-v1"), "plans"),
        (("tdmpc2", "swm/PendulumControl-v1"), "acts"),
        (("inverse", "swm/TwoRoom-v1"), "acts"),
    ],
    indirect=["retrained"],
)
def test_the_weights_that_were_loaded_play_after_their_checkpoint_was_replaced(retrained, tmp_path, kind):
    def policy(model):
        if kind == "acts":
            return FeedForwardPolicy(model)
        solver = swm.planning.CEMSolver(model, num_samples=8, n_steps=1, topk=2)
        return MPCPolicy(solver, swm.PlanConfig(horizon=2, receding_horizon=1))

    def played(model):
        settings = {"policy": policy(model), "episodes": 2, "seed": 0, "progress": False}
        with swm.World(retrained.env, 2, image_shape=(64, 64), max_episode_steps=4) as world:
            found = world.evaluate(**settings).results
            world.collect(tmp_path / "e.lance", mode="overwrite", **settings)
        dataset = swm.data.load_dataset(tmp_path / "e.lance", backend="numpy")
        actions = np.nan_to_num(dataset.get_col_data("action")).tolist()
        hashes = [list(found["manifest"]["hashes"].values()), list(dataset.manifest["hashes"].values())]
        assert hashes == [[model.card["weights"]]] * 2
        return found["runs"][0]["episodes"], actions

    path = retrained(0)
    model, first = swm.wm.load(path), played(swm.wm.load(path))
    retrained(1)
    assert played(model) == first != played(swm.wm.load(path))
    shutil.rmtree(path)
    assert played(model) == first
    retrained(1)
    for copied in (copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))):
        with pytest.raises(ValueError, match="its weights were replaced since the model was loaded; load it again"):
            copied(model)


def test_evaluations_start_from_the_dataset_that_was_opened(tmp_path):
    path, starts = tmp_path / "d.lance", {"goal_offset": 2, "eval_budget": 2, "progress": False}
    collected(path, RandomPolicy(1))
    opened = swm.data.load_dataset(path)

    class Mirrored(type(opened)):
        def load_episode(self, episode_idx):
            return super().load_episode(episode_idx)

    with rooms() as world:
        with pytest.raises(TypeError, match="World.evaluate: .* would not call Mirrored.load_episode"):
            world.evaluate(policy=RandomPolicy(), dataset=Mirrored(path), episodes=1, **starts)
        world.evaluate(policy=RandomPolicy(), dataset=opened, episodes=1, **starts)
        world.collect(path, policy=RandomPolicy(2), episodes=2, seed=9, mode="overwrite", progress=False)
        with pytest.raises(RuntimeError, match="replaced since the dataset was opened"):
            world.evaluate(policy=RandomPolicy(), dataset=opened, episodes=1, **starts)
    with swm.World("swm/Piecewise-v0", 2, image_shape=(32, 32)) as other:
        with pytest.warns(UserWarning, match="collected in swm/TwoRoom-v1, and its states are starts in swm/Piecewise-v0"):
            other.evaluate(policy=RandomPolicy(), dataset=path, episodes=1, **starts)
