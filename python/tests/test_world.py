"""Tests of `World`: interactive loops, collection and evaluation."""

import gc
import json
import os
import resource
import signal
import subprocess
import sys
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import gymnasium as gym
import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel.wrapper.visual import GrayscaleWrapper, NoiseWrapper, linear


def rooms(**more):
    return swm.World("swm/TwoRoom-v1", **{"num_envs": 3, "image_shape": (32, 32), **more})


class Zero(swm.policy.BasePolicy):
    """A policy implemented in Python."""

    def __init__(self, value=0.0):
        super().__init__()
        self.value, self.fresh = value, 0

    def get_action(self, infos, **kwargs):
        self.fresh += int(infos.get("_needs_flush", np.zeros(1)).sum())
        return np.full(self.env.action_space.shape, self.value, dtype=np.float32)


class Complex(Zero):
    """A policy whose actions are complex numbers."""

    def get_action(self, infos, **kwargs):
        return super().get_action(infos, **kwargs) + 1j


def test_every_step_overwrites_the_arrays_of_infos():
    world = rooms()
    world.set_policy(swm.policy.RandomPolicy(seed=1))
    world.reset(seed=0)
    pixels, state = world.infos["pixels"], world.infos["state"]
    assert pixels.shape == (3, 1, 32, 32, 3) and pixels.dtype == np.uint8
    assert world.infos["goal"].any() and np.isnan(world.infos["action"]).all()
    before, kept = state.copy(), world.infos["pixels"]
    world.step()
    assert world.infos["pixels"] is kept and not np.array_equal(state, before)
    assert world.rewards.shape == world.terminateds.shape == world.truncateds.shape == (3,)
    assert world.infos["step_idx"].ravel().tolist() == [1, 1, 1]


def test_episode_does_not_depend_on_other_environments_or_threads():
    def played(envs, threads):
        world = rooms(num_envs=envs, threads=threads)
        world.set_policy(swm.policy.RandomPolicy(seed=5))
        world.reset(seed=3)
        rows = []
        for _ in range(10):
            world.step()
            rows.append({key: value[0].copy() for key, value in world.infos.items()})
        return rows

    for one, other in zip(played(1, 1), played(4, 2), strict=True):
        for key, value in one.items():
            assert np.array_equal(value, other[key], equal_nan=value.dtype.kind == "f"), key


def test_step_after_the_last_step_starts_new_episodes():
    world = rooms(max_episode_steps=4)
    world.set_policy(Zero())
    world.reset(seed=0)
    first = world.envs.seeds.copy()
    for _ in range(4):
        world.step()
    assert world.truncateds.all()
    world.step()
    assert not world.truncateds.any() and (world.infos["step_idx"] == 0).all()
    assert not set(first) & set(world.envs.seeds)


def test_factors_are_sampled_and_pinned():
    world = rooms()
    world.set_policy(Zero())
    names = world.variation_space.names()
    assert "agent.color" in names
    world.reset(seed=0, options={"variation": ["agent.color"], "variation_values": {"background.color": [0.1, 0.2, 0.9]}})
    colours = [tuple(world.factors(i)["agent.color"]) for i in range(3)]
    assert len(set(colours)) > 1
    # Fractions of 1 are scaled to 0..255.
    assert world.factors(0)["background.color"] == [26.0, 51.0, 230.0]
    # Floats from 0 to 1 are fractions, integers are values of 255.
    for given, stored in (
        ([1.0, 0.0, 0.0], [255, 0, 0]),
        (np.float32([1, 1, 0]), [255, 255, 0]),
        ([1, 0, 0], [1, 0, 0]),
        (np.uint8([1, 1, 0]), [1, 1, 0]),
        ([2.0, 1.0, 0.0], [2, 1, 0]),
    ):
        world.reset(seed=0, options={"variation_values": {"background.color": given}})
        assert world.factors(0)["background.color"] == stored
    with pytest.raises(ValueError, match="agent.color"):
        world.reset(options={"variation": ["agent.colour"]})
    with pytest.raises(ValueError, match="variations"):
        world.reset(options={"variations": ["all"]})


def test_mixtures_with_noise_equal_for_any_number_of_environments(tmp_path):
    for num_envs in (1, 4):
        world = rooms(num_envs=num_envs, max_episode_steps=6)
        path = tmp_path / f"{num_envs}.lance"
        mixture = {"expert": 0.5, "random": 0.5}
        world.collect(path, episodes=12, seed=1, policy=mixture, action_noise=0.1, progress=False)
    one, other = (swm.data.load_dataset(str(tmp_path / name), backend="numpy") for name in ("1.lance", "4.lance"))
    assert set(one.get_col_data("policy_index").ravel()) == {0, 1}
    for column in ("policy_index", "action", "state"):
        assert np.array_equal(one.get_col_data(column), other.get_col_data(column), equal_nan=True)
    assert isinstance(world.policy, swm.policy.MixturePolicy)
    with pytest.raises(ValueError, match="give a positive weight"):
        world.collect(tmp_path / "c.lance", episodes=1, policy={"expert": 1, "random": 0}, progress=False)
    with pytest.raises(ValueError, match="unknown policy 'exprt'"):
        world.collect(tmp_path / "c.lance", episodes=1, policy={"exprt": 1}, progress=False)
    with pytest.raises(ValueError, match="at least 0"):
        world.collect(tmp_path / "c.lance", episodes=1, policy=mixture, action_noise=-1, progress=False)


@pytest.mark.parametrize("in_place", [True, False])
def test_changed_weights_of_a_mixture_reach_its_world(in_place):
    def first_actions():
        world.reset(seed=0)
        world.step()
        return world.infos["action"].copy()

    world = rooms()
    random, expert = ({"expert": 1e-9, "random": 1}, {"expert": 1e9, "random": 1})
    world.set_policy(swm.policy.MixturePolicy(expert))
    expected = first_actions()
    mixture = swm.policy.MixturePolicy(random)
    world.set_policy(mixture)
    assert not np.array_equal(first_actions(), expected)
    if in_place:
        mixture.weights["expert"] = 1e9
    else:
        mixture.weights = expert
    assert np.array_equal(first_actions(), expected)


def test_python_policy_collects_new_and_appended_episodes(tmp_path):
    world = rooms(max_episode_steps=6)
    policy = Zero(0.5)
    world.set_policy(policy)
    outcome = world.collect(tmp_path / "a.lance", episodes=5, seed=1, progress=False)
    assert outcome == {"episodes": 5, "added": 5, "steps": 30} and policy.fresh >= 5
    data = swm.data.load_dataset(str(tmp_path / "a.lance"), backend="numpy")
    actions = data.get_col_data("action")
    rows = np.tile([True] * 6 + [False], 5)
    assert (actions[rows] == 0.5).all() and np.isnan(actions[~rows]).all()
    # The dataset exists already.
    with pytest.raises(ValueError, match="it exists already"):
        world.collect(tmp_path / "a.lance", episodes=5, seed=1, progress=False)
    more = world.collect(tmp_path / "a.lance", episodes=2, seed=1, mode="append", progress=False)
    assert more == {"episodes": 7, "added": 2, "steps": 12}
    again = world.collect(tmp_path / "b.h5", episodes=7, seed=1, progress=False)
    assert again["episodes"] == 7
    one, other = (swm.data.load_dataset(str(tmp_path / name), backend="numpy") for name in ("a.lance", "b.h5"))
    assert np.array_equal(one.get_col_data("state"), other.get_col_data("state"))


class Smooth(Zero):
    """A policy that depends on the action before."""

    def get_action(self, infos, **kwargs):
        return 0.8 * np.nan_to_num(infos["action"][:, 0]) + 0.1


def test_the_action_before_the_first_is_that_of_no_other_episode(tmp_path):
    def played(num_envs, before):
        with rooms(num_envs=num_envs, max_episode_steps=5) as world:
            world.set_policy(Smooth())
            for _ in range(before):
                world.evaluate(episodes=3, seed=1, progress=False, floor=False)
            path = tmp_path / f"{num_envs}-{before}.lance"
            world.collect(path, episodes=4, seed=0, progress=False)
        stored = swm.data.load_dataset(path)
        return [np.asarray(stored.load_episode(index)["action"]) for index in range(4)]

    expected = played(1, 0)
    np.testing.assert_allclose(expected[0][:2], [[0.1] * 2, [0.18] * 2], rtol=1e-5)
    for case in ((4, 0), (4, 1), (1, 1)):
        np.testing.assert_array_equal(played(*case), expected)


@pytest.mark.parametrize("policy", [Zero(), swm.policy.RandomPolicy()])
def test_infos_of_a_new_episode_have_no_action(policy):
    with rooms(max_episode_steps=2) as world:
        world.set_policy(policy)
        world.reset(seed=0)
        had = []
        for _ in range(4):
            world.step()
            had.append(bool(np.isfinite(world.infos["action"]).all()))
            assert np.isnan(world.infos["action"]).all() != had[-1]
        assert had == [True, True, False, True]
        state = world.snapshot(1)
        world.restore(state, 1)
        assert np.isnan(world.infos["action"][1]).all() and np.isfinite(world.infos["action"][0]).all()


def test_evaluation_reports_intervals_and_the_random_floor(tmp_path):
    world = rooms()
    metrics = world.evaluate(
        policy=swm.policy.ExpertPolicy(), episodes=12, seed=2, video=tmp_path / "videos", videos=2, progress=False
    )
    assert metrics["success_rate"] > metrics["random_success_rate"]
    low, high = metrics["interval"]
    assert low < metrics["success_rate"] <= high and len(metrics["episode_successes"]) == 12
    assert len(list((tmp_path / "videos").glob("*.mp4"))) == 2
    again = rooms(num_envs=5).evaluate(policy=swm.policy.ExpertPolicy(), episodes=12, seed=2, progress=False)
    assert np.array_equal(metrics["steps"], again["steps"]) and np.array_equal(metrics["seeds"], again["seeds"])
    saved = json.loads(metrics.save(tmp_path / "results.json").read_text())
    assert [run["policy"] for run in saved["runs"]] == ["random", "expert"]


def test_metrics_replace_older_results_as_a_whole_and_nothing_else(tmp_path):
    world = rooms(num_envs=2)
    few, many = (world.evaluate(policy=swm.policy.RandomPolicy(), episodes=n, seed=1, progress=False) for n in (2, 40))
    path = few.save(tmp_path / "results.json")
    old = path.read_text()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(old), limits[1]))
        with pytest.raises(OSError):
            many.save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_text() == old and [file.name for file in tmp_path.iterdir()] == ["results.json"]
    assert len(json.loads(many.save(path).read_text())["runs"][0]["episodes"]) == 40
    thesis = tmp_path / "thesis.md"
    thesis.write_text("thesis")
    with pytest.raises(FileExistsError, match="holds no results"):
        few.save(thesis)
    assert thesis.read_text() == "thesis"


def test_results_and_videos_stay_on_this_machine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    world = swm.World("swm/TwoRoom-v1", num_envs=1, image_shape=(16, 16), max_episode_steps=3)
    world.set_policy(swm.policy.RandomPolicy(1))
    with pytest.raises(ValueError, match="video: 's3://bucket/v' is a URI"):
        world.evaluate(episodes=1, seed=0, video="s3://bucket/v", progress=False)
    metrics = world.evaluate(episodes=1, seed=0, progress=False)
    with pytest.raises(ValueError, match="path: 'gs://bucket/r.json' is a URI"):
        metrics.save("gs://bucket/r.json")
    assert list(tmp_path.iterdir()) == []


def test_metrics_replace_no_pipe(tmp_path):
    with rooms(num_envs=1, max_episode_steps=3) as world:
        world.set_policy(Zero())
        metrics = world.evaluate(episodes=1, seed=0, progress=False, floor=False)
    os.mkfifo(tmp_path / "results.json")
    (tmp_path / "other.json").symlink_to(tmp_path / "results.json")
    for name in ("results.json", "other.json"):
        with pytest.raises(FileExistsError, match="not a regular file"):
            metrics.save(tmp_path / name)
    assert (tmp_path / "results.json").is_fifo() and len(list(tmp_path.iterdir())) == 2


def test_threads_save_metrics_to_one_file(tmp_path):
    metrics = rooms(num_envs=2).evaluate(policy=swm.policy.RandomPolicy(), episodes=2, seed=1, progress=False)
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(lambda _: metrics.save(tmp_path / "results.json"), range(200)))
    assert len(json.loads((tmp_path / "results.json").read_text())["runs"][0]["episodes"]) == 2
    assert [file.name for file in tmp_path.iterdir()] == ["results.json"]


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (np.zeros((2, 3)), r"actions: got actions of shape \(2, 3\), expected \(3, 2\)"),
        (np.full((3, 2), 0.5 + 9j), "actions: expected real actions"),
        (np.full((3, 2), "0.5", object), "actions: expected real actions"),
        (np.full((3, 2), np.nan), "actions: expected finite actions"),
    ],
)
def test_steps_refuse_other_actions(actions, words):
    world = rooms(num_envs=3)
    world.reset(seed=0)
    with pytest.raises(ValueError, match=words):
        world.envs.step(actions)


def test_discrete_actions_are_whole_numbers():
    world = swm.World("swm/CartPoleControl-v1", num_envs=2)
    world.reset(seed=0)
    world.envs.step(np.array([1.0, 0.0]))
    with pytest.raises(ValueError, match="actions: expected whole numbers"):
        world.envs.step(np.array([1.0, 0.7]))
    world.envs.step(np.array([1, 0.0], object))
    for wrong, words in (([1, 0.7], "whole numbers"), ([1, None], "finite actions")):
        with pytest.raises(ValueError, match=f"actions: expected {words}"):
            world.envs.step(np.array(wrong, object))
    for wrong in (1j, np.complex64(1j), "1"):
        with pytest.raises(ValueError, match="actions: expected real actions, got complex numbers or texts"):
            world.envs.step(np.array([1, wrong], object))
    for wrong, words in ((np.uint64([2**64 - 1, 0]), "integers of int64"), (np.array([1e300, 0]), "integers of int64")):
        with pytest.raises(ValueError, match=f"actions: expected {words}"):
            world.envs.step(wrong)
    with pytest.raises(ValueError, match="actions: expected actions without masked values"):
        world.envs.step(np.ma.array([1, 0], mask=[True, False]))
    # Floats have no such number.
    with pytest.raises(ValueError, match=f"discrete action .{2**53 + 1}"):
        world.envs.step(np.array([2**53 + 1, 0], object))


def test_metrics_name_the_episodes_that_count():
    metrics = swm.world.Metrics(success_rate=50.0, interval=(9.5, 90.5), seeds=np.arange(3))
    metrics.results = {"runs": [{"success": {"n": 2}}]}  # The third episode was solved at its start.
    assert str(metrics) == "50.0 % [10, 90] of 2 episodes"


def test_an_evaluation_of_no_episode_has_no_rate(tmp_path):
    world = rooms(num_envs=1, max_episode_steps=8)
    world.collect(tmp_path / "d.lance", policy=Zero(), episodes=2, seed=0, progress=False)
    metrics = world.evaluate(dataset=tmp_path / "d.lance", episodes=2, goal_offset=1, eval_budget=3, seed=0, progress=False)
    assert metrics["solved_at_start"] == 2 and metrics["interval"] == (0, 100)
    assert np.isnan([metrics["success_rate"], metrics["random_success_rate"]]).all()
    assert str(metrics) == "no episode counts: 2 of 2 starts satisfy the goal already"


def test_evaluation_starts_at_rows_of_a_dataset(tmp_path):
    world = rooms()
    world.set_policy(swm.policy.ExpertPolicy())
    world.collect(tmp_path / "d.lance", episodes=4, seed=0, progress=False)
    dataset = swm.data.load_dataset(str(tmp_path / "d.lance"))
    metrics = world.evaluate(
        dataset=dataset, episodes_idx=[0, 1, 2], start_steps=[0, 2, 1], goal_offset=5, eval_budget=30, progress=False
    )
    assert len(metrics["seeds"]) == 3 and metrics.results["protocol"] == "dataset"
    with pytest.raises(ValueError, match="rows"):
        world.evaluate(dataset=dataset, episodes_idx=[0], start_steps=[9999], goal_offset=5, progress=False)


def test_visual_wrappers_change_frames_but_not_the_goal():
    plain, noisy = (
        rooms(extra_wrappers=wrappers) for wrappers in ([], [partial(NoiseWrapper, std=linear(8, 30, 10)), GrayscaleWrapper])
    )
    for world in (plain, noisy):
        world.reset(seed=0)
    grey = noisy.infos["pixels"]
    assert not np.array_equal(grey, plain.infos["pixels"])
    assert np.array_equal(grey[..., 0], grey[..., 1]) and np.array_equal(noisy.infos["goal"], plain.infos["goal"])
    with pytest.raises(ValueError, match="std"):
        rooms(extra_wrappers=[partial(NoiseWrapper, std=-3)])
    with pytest.raises(TypeError, match="std is no function from a step"):
        rooms(extra_wrappers=[partial(NoiseWrapper, std=lambda step: "loud")])


def test_python_function_and_schedule_give_equal_frames():
    scheduled, tabulated = (
        rooms(extra_wrappers=[partial(NoiseWrapper, std=schedule)])
        for schedule in (linear(8, 28, 10), lambda step: 8 + 2 * min(step, 10))
    )
    for world in (scheduled, tabulated):
        world.set_policy(Zero(0.7))
        world.reset(seed=0)
    first = scheduled.infos["pixels"].copy()
    for _ in range(12):
        assert np.array_equal(scheduled.infos["pixels"], tabulated.infos["pixels"])
        scheduled.step(), tabulated.step()
    assert not np.array_equal(scheduled.infos["pixels"], first)
    with pytest.raises(ValueError, match="std"):
        rooms(extra_wrappers=[partial(NoiseWrapper, std=lambda step: 250.0 + step)])


def test_list_of_seeds_decides_policies_and_later_episodes():
    runs = []
    for _ in range(2):
        world = swm.World("swm/TwoRoom-v1", num_envs=2, add_pixels=False, max_episode_steps=3)
        world.set_policy(swm.policy.RandomPolicy(seed=3))
        world.reset(seed=[11, 12])
        assert world.envs.seeds.tolist() == [11, 12]
        world.step(9)
        assert not {11, 12} & set(world.envs.seeds.tolist())
        runs.append((world.infos["action"].copy(), world.infos["state"].copy(), world.envs.seeds))
    for first, second in zip(*runs, strict=True):
        np.testing.assert_array_equal(first, second)


class Within:
    """A user's policy around one of the engine."""

    def __init__(self, inner):
        self.inner = inner

    def set_env(self, env):
        self.inner.set_env(env)

    def get_action(self, infos):
        return self.inner.get_action(infos)


def test_policy_within_another_is_refused_by_evaluate_with_the_reason():
    world = swm.World("swm/TwoRoom-v1", num_envs=1, add_pixels=False, max_episode_steps=5)
    world.set_policy(Within(swm.policy.RandomPolicy(seed=1)))
    with pytest.raises(RuntimeError, match=r"RandomPolicy: .* acts in World\.step only; .* MixturePolicy"):
        world.evaluate(episodes=1, seed=0)
    world.reset(seed=0)
    world.step(3)


def test_policy_within_another_begins_every_episode():
    played = {}
    for within in (False, True):
        world = swm.World("swm/PushT-v1", num_envs=1, add_pixels=False, max_episode_steps=20)
        policy = swm.policy.ExpertPolicy()
        world.set_policy(Within(policy) if within else policy)
        for episode in range(2):
            world.reset(seed=8)
            actions = []
            for _ in range(45):
                world.step()
                actions.append(world.infos["action"].copy())
            played[within, episode] = np.stack(actions)
    for key in played:
        np.testing.assert_array_equal(played[key], played[False, 0], str(key))


def test_restored_snapshot_refreshes_infos():
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16), image_transform=np.asarray)
    world.reset(seed=1, options={"variation": ["all"]})
    state, before = world.snapshot(1), {key: np.copy(value) for key, value in world.infos.items()}
    world.reset(seed=9, options={"variation": ["all"]})
    other = {key: np.copy(value) for key, value in world.infos.items()}
    world.restore(state, 1)
    for key in ("pixels", "state", "variation.agent.color"):
        np.testing.assert_array_equal(world.infos[key][1], before[key][1], key)
        np.testing.assert_array_equal(world.infos[key][0], other[key][0], key)
        assert not np.array_equal(before[key][1], other[key][1]), key


def test_restored_snapshot_repeats_the_next_step():
    world = rooms(num_envs=1)
    world.set_policy(Zero(0.7))
    world.reset(seed=0)
    state, before = world.snapshot(), world.infos["state"].copy()
    world.step()
    after = world.infos["state"].copy()
    world.restore(state)
    assert np.array_equal(world.infos["state"], before)
    world.step()
    assert np.array_equal(world.infos["state"], after)


@pytest.mark.parametrize("evaluated", [False, True])
def test_restored_snapshot_goes_on_in_a_world_without_episodes(evaluated):
    world = rooms(num_envs=2)
    world.set_policy(Zero(0.7))
    world.reset(seed=0)
    state = world.snapshot(1)
    world.step()
    after = world.infos["state"][1].copy()
    other = world if evaluated else rooms(num_envs=2)
    other.set_policy(Zero(0.7))
    if evaluated:
        other.evaluate(episodes=2, seed=3, floor=False, progress=False)
    other.restore(state, 1)
    other.step()
    assert np.array_equal(other.infos["state"][1], after)


def test_interrupted_evaluation_ends_the_interactive_loop():
    class Interrupting(swm.policy.BasePolicy):
        def get_action(self, infos, **kwargs):
            raise KeyboardInterrupt

    world = rooms(num_envs=1)
    world.set_policy(Zero())
    world.reset(seed=0)
    world.step(3)
    for play in (
        lambda: world.evaluate(episodes=1, seed=0, policy=Interrupting(), progress=False),
        lambda: world.collect(writer=swm.data.ReplayBuffer(100), episodes=1, seed=0, policy=Interrupting(), progress=False),
    ):
        with pytest.raises(KeyboardInterrupt):
            play()
        assert world.seed is None


def test_numbers_of_steps_are_whole_and_actions_are_numbers():
    world = swm.World("swm/TwoRoom-v1", num_envs=1, add_pixels=False)
    world.set_policy(swm.policy.RandomPolicy(1))
    world.reset(seed=0)
    for wrong in (2.7, "3", -1, None):
        with pytest.raises(ValueError, match="steps: .*whole number"):
            world.step(wrong)
    world.step(0)
    for wrong in ([["0.5", "0.5"]], np.array([["2020-01-01", "2020-01-02"]], "M8[s]")):
        with pytest.raises(ValueError, match="expected real actions"):
            world.envs.step(wrong)


def test_changed_snapshots_are_refused():
    # The contacts of Push-T's simulation are at the end; a changed index was restored, and the next step failed.
    world = swm.World("swm/PushT-v1", num_envs=1, add_pixels=False)
    world.set_policy(swm.policy.RandomPolicy(1))
    world.reset(seed=0)
    world.step(2)
    state = world.snapshot()
    for at in range(0, len(state), 101):
        changed = bytearray(state)
        changed[at] ^= 0xFF
        with pytest.raises(ValueError, match="missing or changed"):
            world.restore(bytes(changed))
    for wrong in (b"", state[:-1], state[:9]):
        with pytest.raises(ValueError, match="missing or changed"):
            world.restore(wrong)
    world.restore(state)
    world.step()


def test_options_of_a_reset_are_dicts():
    world = swm.World("swm/TwoRoom-v1", num_envs=2, add_pixels=False)
    for options in (5, ["all", None]):
        with pytest.raises(TypeError, match="options: expected a dict"):
            world.reset(options=options)


@pytest.mark.parametrize(
    "wrong",
    [
        {"seed": 9, "options": {"variation": ["agent"], "variation_values": {"agent.size": 1e9}}},
        {"seed": [9, 9], "options": [{"state": [np.nan]}] * 2},
        {"seed": [9], "options": {"variation": ["agent"]}},
    ],
)
def test_a_refused_reset_leaves_the_world_as_it_was(wrong):
    def played(fails):
        world = swm.World("swm/TwoRoom-v1", num_envs=2, add_pixels=False, max_episode_steps=4)
        world.set_policy(swm.policy.RandomPolicy(1))
        world.reset(seed=1)
        world.step(3)
        if fails:
            with pytest.raises(ValueError):
                world.reset(**wrong)
        assert world.seed == 1 and not any(name.startswith("variation.") for name in world.infos)
        seen = []
        for _ in range(4):
            world.step()
            seen.append({name: world.infos[name].tolist() for name in ("state", "action", "step_idx")})
        return repr((world.envs.seeds.tolist(), seen))

    assert played(True) == played(False)


def test_a_reset_during_a_call_of_another_thread_changes_nothing():
    world = swm.World("swm/TwoRoom-v1", num_envs=2, add_pixels=False)
    seen = []

    class Resetting(Zero):
        def get_action(self, infos):
            with ThreadPoolExecutor(1) as threads, pytest.raises(ValueError, match="another call is using it"):
                threads.submit(world.reset, seed=9, options={"variation": ["all"]}).result()
            seen.append((world.seed, world._varied, world._first_seeds))
            return super().get_action(infos)

    world.set_policy(Resetting())
    world.reset(seed=1)
    world.evaluate(episodes=1, seed=0, eval_budget=2, floor=False, progress=False)
    assert seen and all(kept == (1, [], []) for kept in seen)


def test_a_closed_world_says_so():
    world = rooms(num_envs=2)
    world.reset(seed=0)
    world.close()
    for use in (lambda: world.rewards, lambda: world.envs.step(np.zeros((2, 2))), lambda: world.reset(seed=0)):
        with pytest.raises(RuntimeError, match="the world is closed"):
            use()


@pytest.mark.parametrize("index", [-1, 2, 2**70])
def test_indices_of_no_environment_are_refused(index):
    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16))
    world.reset(seed=0)
    state = world.snapshot(1)
    for call in (world.factors, world.snapshot, lambda index: world.restore(state, index)):
        with pytest.raises(IndexError, match=f"index: {index}; the world has 2 environments"):
            call(index)


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: swm.World("swm/PushTT-v1", image_shape=(8, 8)), ValueError, "swm/PushT-v1"),
        (lambda: rooms(num_envs=0), ValueError, "num_envs"),
        (lambda: rooms(image_shape=(0, 8)), ValueError, "image_shape: 0; expected a whole number of at least 1"),
        (lambda: rooms().step(), RuntimeError, "set_policy"),
        (lambda: rooms().reset(seed=-1), ValueError, "seed: -1; expected a whole number of at least 0"),
        (lambda: rooms().reset(seed="x"), ValueError, "seed: 'x'; expected a whole number"),
        (lambda: rooms().reset(seed=[1, 2]), ValueError, "expected 3 seeds.*got 2"),
        (lambda: rooms(image_shape=64), TypeError, "height, width"),
        (lambda: rooms().set_policy(3), TypeError, "get_action"),
        (lambda: rooms().set_policy(Zero), TypeError, "class"),
        (lambda: rooms().collect("x", episodes=1, policy=Zero(), codec="gif"), ValueError, "jpeg-QUALITY"),
        (lambda: rooms().evaluate(policy=Zero(), episodes=0), ValueError, "at least 1"),
        (lambda: rooms().evaluate(policy=Zero(), videos=1), ValueError, "videos: no folder is named; pass video"),
        (lambda: rooms().evaluate(policy=Zero(), video="v", videos=1.9), ValueError, "videos: 1.9; expected a whole number"),
        (lambda: rooms().evaluate(policy=Zero(), video="v", videos=-1), ValueError, "videos: -1; expected a whole number"),
        (
            lambda: rooms(add_pixels=False).collect("x", 1, policy=Zero(), goal=True),
            ValueError,
            "goal: the world has no frames",
        ),
        (lambda: rooms().collect(writer=[], episodes=1, policy=Zero(), codec="png"), ValueError, "codec: the writer decides"),
        (lambda: swm.policy.RandomPolicy(sed=3), TypeError, "unknown argument 'sed'; did you mean 'seed'"),
        (lambda: rooms().evaluate(policy=Zero(), protocol="loose"), ValueError, "compat"),
        (lambda: rooms().evaluate(policy=Zero(), protocol="compat", hold=3), ValueError, "hold: 3"),
        (lambda: rooms().evaluate(policy=swm.policy.ExpertPolicy("weakk")), ValueError, "weak"),
        (lambda: rooms().evaluate(policy=Zero(), dataset="nothing"), FileNotFoundError, "nothing"),
        (lambda: rooms().evaluate(policy=Zero(), dataset=swm.data.ReplayBuffer(9)), TypeError, "dataset: ReplayBuffer; exp"),
        (lambda: rooms().evaluate(policy=Zero(np.nan), episodes=1, seed=0), ValueError, "finite actions"),
        (lambda: rooms().evaluate(policy=Complex(), episodes=1, seed=0), ValueError, "real actions"),
    ],
)
def test_wrong_arguments_raise_errors_with_the_reason(make, error, words):
    with pytest.raises(error, match=words):
        make()


def test_a_policy_that_closes_the_world_is_told_so():
    class Closing(Zero):
        def get_action(self, infos, **named):
            world.close()
            return np.zeros((2, 2), np.float32)

    world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(32, 32))
    with pytest.raises(RuntimeError, match="the world is closed"):
        world.evaluate(policy=Closing(), episodes=2, seed=0, progress=False)


def test_exception_of_a_policy_is_raised_unchanged(tmp_path):
    class Failing(Zero):
        def get_action(self, infos, **kwargs):
            if infos["step_idx"].max() >= 3:
                raise KeyError("mine")
            return super().get_action(infos)

    world = rooms(max_episode_steps=3)
    world.set_policy(Failing())
    assert world.collect(tmp_path / "finished.lance", episodes=3, seed=0, progress=False)["episodes"] == 3
    world = rooms(max_episode_steps=9)
    with pytest.raises(KeyError, match="mine"):
        world.collect(tmp_path / "failed.lance", episodes=3, seed=0, policy=Failing(), progress=False)


def test_planning_with_the_simulator_beats_the_floor():
    world = rooms(num_envs=2, add_pixels=False)
    solver = swm.solver.CEMSolver("simulator", num_samples=32, n_steps=4, topk=8)
    policy = swm.policy.MPCPolicy(solver, swm.PlanConfig(horizon=10, receding_horizon=5))
    metrics = world.evaluate(policy=policy, episodes=4, seed=0, progress=False)
    assert metrics["success_rate"] > metrics["random_success_rate"] and policy.plans


def test_checkpoint_acts_as_a_policy_of_the_engine(tmp_path):
    """A GCBC trained for two steps acts the same through `get_action` and as a policy of the engine."""
    world = rooms(image_shape=(64, 64))
    world.collect(tmp_path / "rooms.lance", episodes=12, seed=0, policy=swm.policy.ExpertPolicy(), progress=False)
    out = tmp_path / "gcbc"
    swm.wm.train("gcbc", data=str(tmp_path / "rooms.lance"), out=str(out), schedule__steps=2, data__batch_size=4)
    model = swm.wm.load(str(out))
    world.set_policy(swm.policy.FeedForwardPolicy(model))
    world.reset(seed=4)
    infos = {key: value.copy() for key, value in world.infos.items()}
    world.step()
    assert np.array_equal(world.infos["action"][:, 0], np.clip(model.get_action(infos), -1, 1))
    with pytest.raises(ValueError, match="it acts and does not predict"):
        model.get_cost(infos, np.zeros((3, 1, 1, 2), np.float32))


def test_ctrl_c_keeps_finished_episodes(tmp_path):
    program = f"""
import stable_worldmodel as swm
world = swm.World("swm/PushT-v1", num_envs=2, image_shape=(64, 64), max_episode_steps=50)
world.set_policy(swm.policy.RandomPolicy())
print("ready", flush=True)
try:
    world.collect({str(tmp_path / "long.lance")!r}, episodes=1_000_000, seed=0, progress=False)
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""
    child = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline().strip() == "ready"
    time.sleep(1.5)
    os.kill(child.pid, signal.SIGINT)
    assert child.communicate(timeout=60)[0].strip() == "interrupted" and child.returncode == 0
    data = swm.data.load_dataset(str(tmp_path / "long.lance"), backend="numpy")
    assert data.num_episodes > 0 and max(data.lengths) == 51 and data.get_col_data("terminated").sum() < data.num_episodes


def test_policy_that_changes_its_observation_changes_nothing_that_is_stored(tmp_path):
    class Policy(swm.policy.BasePolicy):
        def __init__(self, changes):
            super().__init__()
            self.changes = changes

        def get_action(self, obs, **_):
            if self.changes:
                for name in ("state", "pixels", "goal_state"):
                    obs[name][...] = 0
            return np.full((2, 2), 0.3, np.float32)

    stored = []
    for changes in (False, True):
        world = swm.World("swm/TwoRoom-v1", num_envs=2, image_shape=(16, 16), max_episode_steps=5)
        world.set_policy(Policy(changes))
        path = tmp_path / f"{changes}.lance"
        world.collect(path, episodes=2, seed=0, progress=False)
        stored.append(swm.data.load_dataset(path))
    for episode in range(2):
        kept, changed = (dataset.load_episode(episode) for dataset in stored)
        for name in kept:
            np.testing.assert_array_equal(kept[name], changed[name], err_msg=name)


def test_a_world_closes_all_environments_though_one_raises():
    closed = []

    class Stubborn(gym.Wrapper):
        def close(self):
            closed.append(self)
            super().close()
            if len(closed) == 1:
                raise RuntimeError("it stays open")

    world = swm.World("CartPole-v1", 3, image_shape=(32, 32), extra_wrappers=[Stubborn])
    with pytest.raises(RuntimeError, match="it stays open"):
        world.close()
    world.close()
    assert len(closed) == 3


def test_a_world_keeps_no_policy_that_nobody_else_keeps():
    world = rooms(num_envs=1, add_pixels=False)
    world.reset(seed=0)
    gone = []
    for seed in range(4):
        policy = swm.policy.RandomPolicy(seed=seed)
        gone.append(weakref.ref(policy))
        world.set_policy(policy)
        world.step()
    del policy
    gc.collect()
    assert [one() is None for one in gone] == [True, True, True, False] and len(world._actors) == 1


def test_a_changed_seed_reaches_every_world_of_a_policy():
    both, policy = [rooms(num_envs=1, add_pixels=False) for _ in range(2)], swm.policy.RandomPolicy(seed=1)

    def first_actions():
        for world in both:
            world.reset(seed=0)
            world.step()
        return [world.infos["action"].tolist() for world in both]

    for world in both:
        world.set_policy(policy)
    before = first_actions()
    policy.set_seed(5)
    after = first_actions()
    assert before[0] == before[1] != after[0] == after[1]


def test_outputs_are_paths_of_any_kind(tmp_path):
    class Located(os.PathLike):
        def __fspath__(self):
            return str(tmp_path / "a.h5")

    rooms(max_episode_steps=3).collect(Located(), policy=swm.policy.RandomPolicy(), episodes=2, progress=False)
    assert swm.data.load_dataset(Located()).num_episodes == 2


def test_the_seed_of_a_policy_is_recorded_and_continued(tmp_path):
    world = rooms(num_envs=1, add_pixels=False, max_episode_steps=5)
    path = tmp_path / "d.lance"
    world.collect(path, policy=swm.policy.RandomPolicy(seed=2), episodes=2, seed=5, progress=False)
    assert swm.data.load_dataset(path).manifest["config"]["policy"] == "random,seed=2"
    more = {"episodes": 3, "seed": 5, "progress": False, "mode": "resume"}
    for other in (3, None):
        with pytest.raises(ValueError, match='its episodes were collected with policy "random,seed=2"'):
            world.collect(path, policy=swm.policy.RandomPolicy(seed=other), **more)
    assert world.collect(path, policy=swm.policy.RandomPolicy(seed=2), **more)["added"] == 1
    world.collect(tmp_path / "e.lance", policy=swm.policy.ExpertPolicy(), episodes=1, progress=False)
    assert swm.data.load_dataset(tmp_path / "e.lance").manifest["config"]["policy"] == "expert"


def test_the_factors_of_an_episode_pin_it_again():
    world = rooms(num_envs=1)
    for colour in ([1, 0, 1], [255, 128, 0]):
        world.reset(seed=1, options={"variation_values": {"wall.color": colour}})
        seen, factors = world.infos["pixels"].copy(), world.factors()
        assert factors["wall.color"] == colour
        world.reset(seed=1, options={"variation_values": factors})
        assert (world.infos["pixels"] == seen).all()


class Signed(gym.Env):
    """Has an action space that contains -1, and a frame of random pixels."""

    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    metadata = {"render_modes": ["rgb_array"]}
    frame = np.random.default_rng(0).integers(0, 255, (50, 70, 3), dtype=np.uint8)

    def __init__(self, start=-1, render_mode="rgb_array"):
        self.action_space, self.render_mode = gym.spaces.Discrete(3, start=start), render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), float(action), False, False, {}

    def render(self):
        return self.frame


@pytest.fixture
def signed():
    name = "Signed-v0"
    gym.register(name, Signed)
    yield name
    del gym.registry[name]


def test_minus_one_is_no_action_of_a_dataset(signed, tmp_path):
    given = {"policy": swm.policy.RandomPolicy(), "episodes": 4, "seed": 0, "progress": False}
    with swm.World(signed, add_pixels=False, max_episode_steps=4) as world:
        with pytest.raises(ValueError, match="contains -1, which marks a missing action.*start at 0"):
            world.collect(tmp_path / "d.lance", **given)
        # It acts nevertheless.
        world.set_policy(given["policy"])
        world.reset(seed=0)
        world.step(3)
        assert world.rewards[0] in (-1, 0, 1)
    with swm.World(signed, add_pixels=False, max_episode_steps=4, start=-4) as world:
        assert world.collect(tmp_path / "d.lance", **given)["added"] == 4


def test_frames_are_resized_as_given(signed):
    frames = []
    for resample in (None, "bilinear", "nearest", 0):
        with swm.World(signed, image_shape=(10, 14), image_resample=resample) as world:
            world.reset(seed=0)
            frames.append(world.infos["pixels"][0, 0].copy())
    assert np.array_equal(frames[0], frames[1]) and np.array_equal(frames[2], Signed.frame[2::5, 2::5])
    assert np.array_equal(frames[2], frames[3]) and not np.array_equal(frames[1], frames[2])
    for resample in ("junk", 3, "bicubic"):
        with pytest.raises(ValueError, match="image_resample: .*expected 'bilinear' or 'nearest'"):
            swm.World(signed, image_resample=resample)
    with pytest.raises(ValueError, match="swm_pixel_art"):
        swm.World(signed, image_resample="nearest", workers=True)
