"""Tests of the replay buffer: the latest episodes, and samples that depend on seed and step."""

import copy
import pickle
import sys
import threading

import numpy as np
import pytest
from data_helpers import episode, episodes

import stable_worldmodel as swm
from stable_worldmodel import data


def test_full_buffer_removes_the_oldest_episodes():
    buffer = data.ReplayBuffer(max_steps=50, history_len=3, frameskip=2)
    assert len(buffer) == 0 and buffer.num_steps_stored == 0
    with buffer as writer:
        writer.write_episodes(episodes())
    assert buffer.lengths.tolist() == [9, 30] and buffer.offsets.tolist() == [0, 9]
    assert (buffer.num_episodes, buffer.num_steps_stored, buffer.num_episodes_added) == (2, 39, 4)
    assert len(buffer) == buffer.num_valid_ends() == (9 - 5) + (30 - 5)
    clip = buffer[4]
    assert clip["pixels"].shape == (3, 16, 16, 3) and clip["action"].shape == (3, 4)
    np.testing.assert_array_equal(clip["reward"], [300, 302, 304])
    assert buffer.get_col_data("reward").tolist() == [*range(200, 209), *range(300, 330)]
    assert buffer.get_row_data(9)["reward"] == 300
    assert [len(content["state"]) for content in buffer.episodes()] == [9, 30]
    with pytest.raises(ValueError, match="51 rows.*at most 50"):
        buffer.write_episode(episode(0, 51))
    with pytest.raises(ValueError, match=r"missing \['state'\]"):
        buffer.write_episode({name: array for name, array in episode(0, 5).items() if name != "state"})
    buffer.clear()
    assert len(buffer) == 0
    buffer.write_episode(episode(1, 8))
    assert buffer.lengths.tolist() == [8]


def test_samples_depend_on_seed_and_step():
    buffers = [data.ReplayBuffer(100, history_len=2, seed=seed) for seed in (1, 1, 2)]
    for buffer in buffers:
        buffer.write_episodes(episodes())
    first, again, other = ([buffer.sample(16)["reward"].tolist() for _ in range(2)] for buffer in buffers)
    assert first == again != other and first[0] != first[1]
    assert buffers[0].sample(16, step=0)["reward"].tolist() == first[0]
    batch = buffers[0].sample(4, history_len=5)
    assert batch["pixels"].shape == (4, 5, 16, 16, 3) and batch["action"].shape == (4, 5, 2)
    assert (np.diff(batch["reward"], axis=1) == 1).all()


def test_user_defined_sampler_chooses_the_clips():
    buffer = data.ReplayBuffer(100, history_len=2, sampler=lambda step, buffer, size, history: np.full(size, step))
    with pytest.raises(RuntimeError, match="no clip of 2 steps"):
        buffer.sample(4)
    buffer.write_episodes(episodes())
    batch = buffer.sample(3, step=11)
    np.testing.assert_array_equal(batch["reward"], [[100, 101]] * 3)
    assert batch["action"].shape == (3, 2, 2)
    buffer.sampler = lambda *_: np.zeros(2)
    with pytest.raises(ValueError, match=r"shape \(2,\), expected \(3,\)"):
        buffer.sample(3)


def test_buffer_filters_columns_loads_and_dumps(tmp_path):
    buffer = data.ReplayBuffer(100, history_len=2, key_filter=data.classic_filter)
    buffer.write_episodes(episodes())
    assert buffer.column_names == ["pixels", "action", "reward", "terminated"]
    batch = next(iter(data.Loader(buffer, 8, backend="numpy")))
    assert batch["pixels"].shape == (8, 2, 3, 16, 16)
    buffer.dump(tmp_path / "a.lance")
    dataset = data.load_dataset(tmp_path / "a.lance")
    np.testing.assert_array_equal(dataset.get_col_data("pixels"), buffer.get_col_data("pixels"))


def test_a_dump_replaces_a_dataset_appends_to_it_or_refuses_it(tmp_path):
    buffer = data.ReplayBuffer(100)
    buffer.write_episodes(episodes((5, 6)))
    for mode, expected in (("overwrite", [5, 6]), ("overwrite", [5, 6]), ("append", [5, 6, 5, 6])):
        buffer.dump(tmp_path / "a.lance", mode=mode)
        assert data.load_dataset(tmp_path / "a.lance").lengths.tolist() == expected
    with pytest.raises(FileExistsError, match="there is a dataset already"):
        buffer.dump(tmp_path / "a.lance", mode="error")
    data.ReplayBuffer(100).dump(tmp_path / "a.lance")
    assert data.load_dataset(tmp_path / "a.lance").num_episodes == 4
    buffer.dump(tmp_path / "a.lance")
    assert data.load_dataset(tmp_path / "a.lance").lengths.tolist() == [5, 6]


def test_an_action_in_the_last_row_is_kept():
    buffer = data.ReplayBuffer(max_steps=20, history_len=2)
    steps = {"state": np.arange(4.0)[:, None], "action": np.arange(4, dtype=np.float32)[:, None]}
    buffer.write_episode(steps)
    assert buffer[-1]["action"].ravel().tolist() == [2, 3]
    assert np.isfinite(buffer.sample(64)["action"]).all()
    missing = {**steps, "action": np.array([[0], [np.nan], [2], [3]], np.float32)}
    with pytest.raises(ValueError, match="row 1 of 4"):
        buffer.write_episode(missing)


def test_negative_indices_count_from_the_end_as_in_stored_datasets(tmp_path):
    buffer = data.ReplayBuffer(100, history_len=2)
    buffer.write_episodes(episodes())
    buffer.dump(tmp_path / "a.lance")
    stored = data.load_dataset(tmp_path / "a.lance", num_steps=2, backend="numpy")
    for both in (lambda it: it[-1], lambda it: it.load_episode(-1), lambda it: it.load_chunk([-1], [0], [3])[0]):
        np.testing.assert_array_equal(both(buffer)["state"], both(stored)["state"])
    for rows in (-1, [-2, 0]):
        np.testing.assert_array_equal(buffer.get_row_data(rows)["state"], stored.get_row_data(rows)["state"])
    for dataset in (buffer, stored):
        with pytest.raises(IndexError, match="episode 9 is outside the dataset, which has"):
            dataset.load_episode(9)
        with pytest.raises(IndexError, match=r"rows \[-101\] are outside the dataset"):
            dataset.get_row_data(-101)


def test_lengths_cannot_be_written_to(tmp_path):
    buffer = data.ReplayBuffer(100)
    buffer.write_episodes(episodes())
    buffer.dump(tmp_path / "a.lance")
    stored = data.load_dataset(tmp_path / "a.lance")
    for dataset in (buffer, stored, pickle.loads(pickle.dumps(stored)), copy.deepcopy(stored)):
        for rows in (dataset.lengths, dataset.offsets):
            with pytest.raises(ValueError, match="read-only"):
                rows[0] = 1


def test_joined_buffers_are_read_as_they_were_when_another_thread_clears_them():
    class Cleared(data.ReplayBuffer):
        """A buffer that another thread clears between the counts of a joined dataset and its reads."""

        def __getitem__(self, idx):
            joined[0].clear()
            return super().__getitem__(idx)

        def load_episode(self, episode_idx):
            joined[0].clear()
            return super().load_episode(episode_idx)

        def load_chunk(self, *run):
            joined[0].clear()
            return super().load_chunk(*run)

    for read in (lambda it: it[-1], lambda it: it.load_episode(-1), lambda it: it.load_chunk([-1], [0], [8])[0]):
        joined = [Cleared(100, history_len=2)]
        joined[0].write_episodes(episodes())
        expected = read(joined[0]._now)
        both = data.ConcatDataset(joined)
        np.testing.assert_array_equal(read(both)["state"], expected["state"])
        with pytest.raises(IndexError, match="outside the dataset, which has 0"):
            read(both)


def numbered(length):
    """An episode whose rows have their number and the length of the episode."""
    return {"action": np.ones((length, 1), np.float32), "length": np.full(length, length), "row": np.arange(length)}


def test_episodes_are_whole_while_another_thread_writes():
    buffer = data.ReplayBuffer(60, history_len=2)
    chosen = data.ReplayBuffer(
        60, history_len=2, sampler=lambda _, it, size, steps: np.full(size, it.num_valid_ends(steps) - 1)
    )
    buffers = (buffer, chosen)
    for one in buffers:
        one.write_episode(numbered(3))

    def write():
        for number in range(3000):
            for one in buffers:
                one.write_episode(numbered(3 + number * 7 % 11))

    writer = threading.Thread(target=write)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        writer.start()
        while writer.is_alive():
            read = [buffer.load_episode(0), *buffer.episodes(), *copy.deepcopy(buffer).episodes()]
            assert all(len(content["row"]) == content["length"][0] for content in read)
            assert np.diff(buffer[0]["row"]).tolist() == [1]
            batch = chosen.sample(4)
            assert (batch["row"][:, -1] + 1 == batch["length"][:, -1]).all(), "the sampler chose the last clip"
    finally:
        writer.join()
        sys.setswitchinterval(interval)
    assert buffer.num_episodes_added == 3001


def test_goals_of_a_buffer_are_those_of_its_content_now():
    buffer = data.ReplayBuffer(max_steps=24, history_len=2)
    for number, length in enumerate([6, 6, 12, 6, 7]):
        buffer.write_episode({"episode": np.full(length, number), "t": np.arange(length)})
        if number == 2:
            goals = data.GoalDataset(
                buffer, goal_probabilities=(0, 1, 0, 0), goal_keys={"episode": "goal_episode", "t": "goal_t"}, seed=1
            )
        if number < 2:
            continue
        assert len(goals) == sum(int(length) - 2 for length in buffer.lengths)
        for sample in (goals[i] for i in range(len(goals))):
            assert sample["goal_episode"][0] == sample["episode"][0] and sample["goal_t"][0] > sample["t"][-1]
    assert len(pickle.loads(pickle.dumps(goals))) == len(goals)


class Marked(data.ReplayBuffer):
    """A buffer that returns its mark in place of the rows."""

    mark = 5

    def __getitem__(self, idx):
        return {**super().__getitem__(idx), "row": np.full(self.num_steps, self.mark)}

    def _load_slice(self, ep_idx, start, end):
        return {**super()._load_slice(ep_idx, start, end), "row": np.full(1, self.mark + 1)}


def test_methods_of_a_derived_buffer_are_called_or_refused(tmp_path):
    buffer = Marked(100, history_len=2)
    buffer.write_episode(numbered(6))
    for dataset in (buffer, data.ConcatDataset([buffer]), data.MergeDataset([data.ConcatDataset([buffer, buffer])])):
        assert data.ConcatDataset([dataset])[0]["row"].tolist() == [5, 5]
        goals = data.GoalDataset(dataset, goal_keys={"row": "goal"}, seed=0)
        clips = len(goals)
        assert (goals[0]["row"].tolist(), goals[0]["goal"].tolist()) == ([5, 5], [6])
        buffer.mark = 7
        assert (goals[0]["row"].tolist(), goals[0]["goal"].tolist()) == ([7, 7], [8])
        buffer.mark = 5
        buffer.write_episode(numbered(6))
        assert len(goals) > clips and goals[clips]["row"].tolist() == [5, 5]
        with pytest.raises(TypeError, match="Loader: .* Marked.__getitem__; use torch's DataLoader"):
            data.Loader(dataset, batch_size=2)
        with pytest.raises(TypeError, match="convert: .* Marked.__getitem__; write the episodes .* open_writer"):
            data.convert(dataset, tmp_path / "copy.h5", progress=False)
    assert not (tmp_path / "copy.h5").exists()


def test_a_derived_buffer_that_reads_the_same_is_loaded_and_converted(tmp_path):
    class Named(data.ReplayBuffer):
        name = "mine"

    buffer = Named(100, history_len=2, transform=lambda sample: {"row": sample["row"] * 2})
    buffer.write_episode(numbered(6))
    assert next(iter(data.Loader(buffer, batch_size=1, shuffle=False, backend="numpy")))["row"].tolist() == [[0, 2]]
    assert len(data.GoalDataset(buffer, goal_keys={"row": "goal"})) == 4
    data.convert(buffer, tmp_path / "copy.h5", progress=False)
    assert data.load_dataset(tmp_path / "copy.h5", backend="numpy").get_col_data("row").tolist() == [*range(6)]


def test_a_buffer_keeps_few_samplers():
    buffer = data.ReplayBuffer(100)
    buffer.write_episode(numbered(20))
    first = buffer.sample(3, step=0)
    kept = next(iter(buffer._samplers.values()))
    for size in range(4, 40):
        buffer.sample(size)
        # The one that is used stays.
        np.testing.assert_array_equal(buffer.sample(3, step=0)["row"], first["row"])
    assert len(buffer._samplers) == 4 and kept in buffer._samplers.values()
    for steps in range(1, 10):
        buffer.sample(4, steps)
    assert kept not in buffer._samplers.values()
    np.testing.assert_array_equal(buffer.sample(3, step=0)["row"], first["row"])
    again = pickle.loads(pickle.dumps(buffer))
    np.testing.assert_array_equal(again.sample(3, step=0)["row"], first["row"])
    buffer.clear()
    assert not buffer._samplers
    for copied in (pickle.loads(pickle.dumps(buffer)), copy.deepcopy(buffer)):
        with pytest.raises(ValueError, match="must have the buffer's columns"):
            copied.write_episode({"other": np.zeros(3)})


def test_writer_that_suppresses_its_error_collects_nothing_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setenv("STABLEWM_HOME", str(tmp_path))

    class Full:
        def __enter__(self):
            return self

        def __exit__(self, *error):
            return True

        def write_episode(self, episode):
            raise OSError("the disk is full")

    with swm.World("swm/TwoRoom-v1", 1, image_shape=(32, 32), max_episode_steps=5) as world:
        world.set_policy(swm.policy.RandomPolicy(0))
        with pytest.raises(OSError, match="the disk is full"):
            world.collect(writer=Full(), episodes=3, seed=1, progress=False)
    assert not list(tmp_path.iterdir())
