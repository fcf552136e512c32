"""Tests of the loader: epochs, order, saved positions, goals, interrupts and errors."""

import signal
import subprocess
import sys
import types

import numpy as np
import pytest
from data_helpers import LENGTHS, clips, same, write

from stable_worldmodel import data
from stable_worldmodel.data._tensors import to_numpy


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "a.lance"
    return path, write(path)


def loader(path, **kwargs):
    given = {"batch_size": 8, "num_steps": 3, "frameskip": 2, "backend": "numpy", **kwargs}
    return data.Loader(path, **given)


def identities(batches):
    """Identifies the clips of batches by their first rewards, which are all different."""
    return [batch["reward"][:, 0].ravel().tolist() for batch in batches]


def test_batches_are_clips_in_order(stored):
    path, written = stored
    expected = clips(written, 3, 2)
    at = 0
    for batch in loader(path, shuffle=False):
        for i in range(len(batch["action"])):
            same({name: column[i] for name, column in batch.items()}, expected[at], True)
            at += 1
    assert at == len(expected)


def test_epoch_has_every_clip_once_in_random_order(stored):
    path, written = stored
    expected = sorted(clip["reward"][0] for clip in clips(written, 3, 2))
    first, second = (sum(identities(loader(path, seed=seed)), []) for seed in (1, 2))
    assert sorted(first) == sorted(second) == expected
    assert first != second != expected
    same_seed = loader(path, seed=1, threads=0, cache="64MB", prefetch=1)
    assert len(same_seed) == 7 and same_seed.num_clips == 51
    epochs = [sum(identities(same_seed), []) for _ in range(2)]
    assert epochs[0] == first != epochs[1] and sorted(epochs[1]) == expected
    same_seed.set_epoch(0)
    assert sum(identities(same_seed), []) == first
    assert len(list(loader(path, drop_last=True))) == 6


@pytest.mark.parametrize("world_size", [1, 2, 3, 4, 9])
def test_slices_of_all_ranks_are_the_batches(stored, world_size):
    path, _ = stored
    goals = data.Goals(columns=["reward"], future=1.0, random=0.0, geometric=0.0, current=0.0)
    settings = {"seed": 3, "batch_size": 23, "goals": goals}
    whole = list(loader(path, **settings))
    ranks = [loader(path, rank=rank, world_size=world_size, **settings) for rank in range(world_size)]
    assert {len(rank) for rank in ranks} == {len(whole)} and {rank.num_clips for rank in ranks} == {47}
    for batch, *slices in zip(whole, *ranks, strict=True):
        for name, column in batch.items():
            np.testing.assert_array_equal(np.concatenate([part[name] for part in slices]), column, err_msg=name)
        sizes = [len(part["action"]) for part in slices]
        assert max(sizes) - min(sizes) <= 1
    # The last batch has one clip.
    assert sizes == [1] + [0] * (world_size - 1)


def test_an_empty_slice_is_transformed(stored):
    path, _ = stored
    seen = []

    def transform(batch):
        seen.append(batch["action"].shape)
        return batch

    ranks = loader(path, batch_size=50, rank=1, world_size=2, transform=transform)
    assert [batch["action"].shape for batch in ranks] == [(25, 3, 4), (0, 3, 4)]
    assert seen == [(25, 6, 2), (0, 6, 2)]
    with pytest.raises(ValueError, match="rank 2 of 2"):
        loader(path, rank=2, world_size=2)
    with pytest.raises(ValueError, match="negative"):
        loader(path, rank=-1)


def test_tensors_are_on_the_device(stored):
    torch = pytest.importorskip("torch")
    path, _ = stored
    for batch in loader(path, backend="torch", device="cpu", pin_memory=True):
        assert all(value.device.type == "cpu" and isinstance(value, torch.Tensor) for value in batch.values())
    if torch.cuda.is_available():
        assert all(value.is_pinned() for batch in loader(path, backend="torch", pin_memory=True) for value in batch.values())
        on_gpu = loader(path, backend="torch", device="cuda", pin_memory=True, shuffle=False)
        for found, expected in zip(on_gpu, loader(path, shuffle=False), strict=True):
            assert all(value.is_cuda for value in found.values())
            same({name: value.cpu() for name, value in found.items()}, expected)
    with pytest.raises(ValueError, match="backend='torch'"):
        loader(path, device="cpu")


def test_saved_position_continues_with_the_same_batches(stored):
    path, _ = stored
    complete = loader(path, seed=5)
    epochs = [identities(complete), identities(complete)]
    for stop in (3, 7):
        stopped = loader(path, seed=5)
        batches = iter(stopped)
        for _ in range(stop):
            next(batches)
        resumed = loader(path, seed=5)
        resumed.load_state_dict(stopped.state_dict())
        assert identities(resumed) == (epochs[0][stop:] if stop < 7 else epochs[1])
        if stop < 7:
            assert identities(resumed) == epochs[1]
    # After an iteration that ended early, the next iteration yields the next epoch.
    next(iter(stopped := loader(path, seed=5)))
    assert identities(stopped) == epochs[1]
    with pytest.raises(ValueError, match="seed was 5 and is 6"):
        loader(path, seed=6).load_state_dict(complete.state_dict())
    with pytest.raises(ValueError, match="shuffle was 1 and is 0"):
        loader(path, seed=5, shuffle=False).load_state_dict(complete.state_dict())
    steps, skip = complete.num_steps, complete.frameskip
    other = loader(path, seed=5, num_steps=1, frameskip=steps * skip)
    with pytest.raises(ValueError, match=f"num_steps was {steps} and is 1"):
        other.load_state_dict({**complete.state_dict(), "clips": other.num_clips})
    for other in ({}, None):
        with pytest.raises(ValueError, match="expected what state_dict returned"):
            complete.load_state_dict(other)
    for wrong, error in (({"batch": 2.9}, TypeError), ({"batch": 10**9}, ValueError), ({"epoch": -1}, ValueError)):
        with pytest.raises(error):
            complete.load_state_dict({**complete.state_dict(), **wrong})


def test_goals_are_later_rows_of_the_episode(stored):
    path, _ = stored
    later = data.Goals(columns=["reward", "pixels"], random=0, current=0, geometric=1, discount=0.5)
    end = data.Goals(columns=["reward"], random=0, current=0, geometric=0, last=1, name="end")
    lasts = {100 * i + length - 1 for i, length in enumerate(LENGTHS)}
    for batch in loader(path, goals=[later, end]):
        assert batch["goal_pixels"].shape[1:] == (1, 3, 16, 16)
        ahead = batch["goal_reward"][:, 0, 0] - batch["reward"][:, -1, 0]
        np.testing.assert_array_equal(ahead, batch["goal_offset"])
        assert (ahead >= 2).all()
        assert set(batch["end_reward"].ravel()) <= lasts
    with pytest.raises(ValueError, match="add up to 1"):
        loader(path, goals=data.Goals(random=1.0))
    for name in ("random", "discount"):
        for value in (float("nan"), float("inf"), -0.5, "often", None):
            with pytest.raises(ValueError, match=rf"Goals.{name}: .*; expected a finite number of at least 0"):
                loader(path, goals=data.Goals(columns=["reward"], **{name: value}))


def test_transform_is_applied_before_frameskip_joins_actions(stored):
    path, _ = stored
    plain = next(iter(loader(path)))
    transform = data.ColumnTransform(data.ZScoreScaler(mean=[0.0, 0.0], std=[2.0, 4.0]), "action", "action")
    scaled = next(iter(loader(path, transform=transform)))
    np.testing.assert_allclose(scaled["action"], plain["action"] / [2, 4, 2, 4])


def relative(sample):
    return {**sample, "state": sample["state"] - sample["state"][0], "sum": sample["action"].sum() + sample["reward"].sum()}


def doubled(sample):
    sample["state"] = 2 * sample["state"]
    return {**sample, "sum": sample["action"].shape[0] + 0 * sample["reward"].sum()}


@pytest.mark.parametrize("backend", ["numpy", "torch"])
@pytest.mark.parametrize("suffix", ["lance", "h5"])
def test_transform_of_a_dataset_gets_every_sample(tmp_path, suffix, backend):
    if backend == "torch":
        pytest.importorskip("torch")
    write(tmp_path / f"a.{suffix}", (8, 9))
    write(tmp_path / f"b.{suffix}", (7,))
    clip = {"num_steps": 3, "frameskip": 2, "backend": backend}
    a, b, plain = (
        data.load_dataset(tmp_path / f"{name}.{suffix}", transform=transform, **clip)
        for name, transform in (("a", relative), ("b", doubled), ("a", None))
    )
    both = data.ConcatDataset([b, a])
    merged = data.MergeDataset([plain, a], [["pixels"], ["state", "action", "reward"]])
    part = data.MergeDataset(
        [plain, data.load_dataset(tmp_path / f"a.{suffix}", transform=dict, **clip)], [["pixels"], ["state"]]
    )
    with pytest.warns(UserWarning, match="the transform of dataset 1 gets the columns state, without .*action"):
        data.Loader(part, batch_size=1)
    nested = data.ConcatDataset([merged, merged])
    for dataset in (a, both, merged, nested):
        batches = list(data.Loader(dataset, 4, shuffle=False, backend=backend))
        found = [{name: column[i] for name, column in batch.items()} for batch in batches for i in range(len(batch["state"]))]
        assert len(found) == len(dataset)
        for i, sample in enumerate(found):
            expected = dataset[i]
            assert set(sample) == set(expected)
            for name, value in expected.items():
                np.testing.assert_array_equal(np.asarray(sample[name]), np.asarray(value), err_msg=name)
    # A process without samples of the last batch has the columns of the others.
    last = list(data.Loader(a, len(a) - 1, shuffle=False, rank=1, world_size=2))[-1]
    assert {name: len(column) for name, column in last.items()} == dict.fromkeys(a[0], 0)
    with pytest.raises(ValueError, match="this process got no samples"):
        list(data.Loader(a, 1, shuffle=False, rank=1, world_size=2))
    # The transform of the loader gets the batch of transformed samples.
    batch = next(iter(data.Loader(a, 4, shuffle=False, transform=lambda batch: {"sums": 2 * batch["sum"]})))
    np.testing.assert_array_equal(np.asarray(batch["sums"]), [2 * np.asarray(a[i]["sum"]) for i in range(4)])
    lengths = iter(range(1, 9))
    a.transform = lambda sample: {"x": np.zeros(next(lengths))}
    with pytest.raises(ValueError, match="values of 'x' cannot be stacked.*use torch's DataLoader"):
        next(iter(data.Loader(a, 4)))


def test_loader_uses_the_settings_of_the_dataset(stored):
    path, _ = stored
    dataset = data.load_dataset(path, num_steps=2, frameskip=3, keys_to_load=["state"], backend="numpy")
    batch = next(iter(data.Loader(dataset, 5)))
    assert {name: column.shape for name, column in batch.items()} == {"state": (5, 2, 4)}
    only = data.Loader(dataset, 100, episodes=[2], columns=["reward"])
    assert {int(r) // 100 for r in next(iter(only))["reward"].ravel()} == {2}


def test_batches_outlive_the_loader(stored):
    path, _ = stored
    made = loader(path, shuffle=False, columns=["pixels"])
    kept = [batch["pixels"] for batch in made]
    copies = [array.copy() for array in kept]
    for _ in made:
        pass
    del made
    for array, copy in zip(kept, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_wrong_arguments_raise_errors_with_the_reason(stored, tmp_path):
    path, _ = stored
    with pytest.raises(KeyError, match="no column 'pixel'"):
        loader(path, columns=["pixel"])
    with pytest.raises(TypeError, match=r"such as \['pixels'\]"):
        loader(path, columns="pixels")
    with pytest.raises(ValueError, match="none of the 4 episodes is long enough"):
        loader(path, num_steps=40)
    with pytest.raises(ValueError, match="batch_size"):
        loader(path, batch_size=0)
    with pytest.raises(ValueError, match="no negative numbers, got {'threads': -1}"):
        loader(path, threads=-1)
    with pytest.raises(ValueError, match="episodes: -1; expected indices from 0 to 3"):
        loader(path, episodes=[0, -1])
    for name in ("batch_size", "num_steps", "frameskip", "rank", "world_size", "threads", "prefetch", "seed"):
        for wrong in (1.5, b"3", True, None if name == "batch_size" else "2"):
            with pytest.raises(ValueError, match=f"{name}: .*; expected a whole number"):
                loader(path, **{name: wrong})
    for call in (
        lambda: data.ReplayBuffer(9, frameskip=1.5),
        lambda: data.ReplayBuffer(9).sample(2, 1.5),
    ):
        with pytest.raises(ValueError, match="whole number"):
            call()
    with pytest.raises(ValueError, match="'12XB'"):
        loader(path, cache="12XB")
    with pytest.raises(FileNotFoundError):
        loader(tmp_path / "nothing.lance")
    with pytest.raises(ValueError, match="stay on the CPU"):
        loader(path, device="cuda")


def test_error_of_a_reader_is_raised_by_the_loader(stored):
    class Broken(data.Dataset):
        column_names = ["state"]

        def _load_slice(self, episode, start, end):
            if episode == 1:
                raise RuntimeError("the disk is gone")
            return {"state": np.zeros((end - start, 2))}

    batches = iter(data.Loader(Broken([6, 6], [0, 6]), 4, shuffle=False, backend="numpy"))
    assert next(batches)["state"].shape == (4, 1, 2)
    with pytest.raises(RuntimeError, match="the disk is gone"):
        list(batches)


def test_stop_iteration_of_a_reader_or_a_transform_does_not_end_the_epoch(stored):
    path, _ = stored

    class Ended(data.Dataset):
        column_names = ["state"]

        def _load_slice(self, episode, start, end):
            return {"state": np.full((end - start, 2), next(iter([] if episode else [0])))}

    def nothing(batch):
        return next(iter([]))

    for batches in (data.Loader(Ended([6, 6], [0, 6]), 4, shuffle=False, backend="numpy"), loader(path, transform=nothing)):
        with pytest.raises(RuntimeError, match="StopIteration"):
            list(batches)


def test_values_are_read_while_another_thread_imports_torch(monkeypatch):
    # A module that is being imported has none of its classes.
    monkeypatch.setitem(sys.modules, "torch", types.ModuleType("torch"))
    np.testing.assert_array_equal(to_numpy([1.0, 2.0]), [1, 2])
    np.testing.assert_array_equal(data.ZScoreScaler(np.ones(1), np.ones(1)).transform(np.ones((1, 1))), [[0]])


WAITING = """
import threading
import numpy as np
from stable_worldmodel import data

enough = threading.Event()

class Slow(data.Dataset):
    column_names = ["state"]

    def _load_slice(self, episode, start, end):
        if episode == 1 and not enough.is_set():
            print("waiting", flush=True)
            enough.wait()
        return {"state": np.zeros((end - start, 2))}

loader = data.Loader(Slow([6, 6], [0, 6]), 6, shuffle=False, backend="numpy", threads=1)
try:
    list(loader)
except KeyboardInterrupt:
    enough.set()
    print("interrupted", flush=True)
"""


def test_ctrl_c_ends_the_wait_for_a_batch():
    process = subprocess.Popen([sys.executable, "-c", WAITING], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "waiting\n"
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert output.splitlines()[-1] == "interrupted" and process.returncode == 0


def test_episodes_are_indices_or_a_mask(tmp_path):
    path = tmp_path / "a.lance"
    with data.open_writer(path) as writer:
        for episode in range(4):
            writer.write_episode({"action": np.zeros((2, 1), np.float32), "x": np.full((3, 1), episode, np.float32)})

    def seen(episodes):
        loader = data.Loader(path, 4, columns=["x"], episodes=episodes, backend="numpy", threads=0)
        return sorted({int(value) for batch in loader for value in np.asarray(batch["x"]).ravel()})

    assert seen([0, 2]) == [0, 2]
    assert seen([True, False, True, False]) == seen(np.array([1, 0, 1, 0], bool)) == [0, 2]
    with pytest.raises(ValueError, match="episodes: expected a mask of 4 booleans"):
        seen([True, False])
    for wrong in ([0.9, 2.9], ["0"], [[0], [1]]):
        with pytest.raises(TypeError, match="episodes: expected indices or a mask"):
            seen(wrong)
    with pytest.raises(ValueError, match="number of threads"):
        data.Loader(path, 4, threads=10**6)
