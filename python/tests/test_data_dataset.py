"""Tests of reading: clips, chunks, columns and rows equal the written episodes."""

import pickle
import re
import subprocess
import sys

import numpy as np
import pytest
from data_helpers import LENGTHS, clips, episode, same, write

from stable_worldmodel import data

FORMATS = {"lance": "a.lance", "hdf5": "a.h5"}


@pytest.fixture(scope="module", params=FORMATS)
def stored(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / FORMATS[request.param]
    return path, write(path), request.param == "lance"


@pytest.mark.parametrize(("num_steps", "frameskip"), [(1, 1), (3, 1), (3, 2), (4, 5)])
def test_clips_are_windows_of_episodes(stored, num_steps, frameskip):
    path, written, lists = stored
    dataset = data.load_dataset(path, num_steps=num_steps, frameskip=frameskip, backend="numpy")
    expected = clips(written, num_steps, frameskip)
    assert len(dataset) == len(dataset.clip_indices) == len(expected)
    together = dataset.__getitems__(range(len(dataset)))
    for i, clip in enumerate(expected):
        same(together[i], clip, lists)
    for i in (0, len(dataset) // 2, -1):
        same(dataset[i], expected[i], lists)


def test_dataset_reports_its_columns_and_lengths(stored):
    path, _, lists = stored
    dataset = data.load_dataset(path, keys_to_load=["action", "reward"])
    assert dataset.column_names == ["action", "reward"]
    assert dataset.lengths.tolist() == list(LENGTHS)
    assert dataset.offsets.tolist() == [0, 12, 32, 41]
    assert dataset.num_episodes == 4
    assert dataset.get_dim("action") == 2
    assert dataset.get_dim("pixels") == 16 * 16 * 3
    assert dataset.schema["reward"] == (np.dtype("float64"), (1,) if lists else ())
    assert dataset.manifest is None
    assert "4 episodes, 71 rows" in repr(dataset)


def test_clips_are_counted_in_whole_numbers_and_columns_are_lists(stored):
    path, _, _ = stored
    for given in ({"num_steps": 1.5}, {"num_steps": "4"}, {"frameskip": None}, {"frameskip": 0}):
        with pytest.raises(ValueError, match=f"{next(iter(given))}: .*; expected a whole number of at least 1"):
            data.load_dataset(path, **given)
    with pytest.raises(TypeError, match="keys_to_load: 'action'; expected a list of columns"):
        data.load_dataset(path, keys_to_load="action")


def test_chunks_episodes_columns_and_rows_equal_the_written_data(stored):
    path, written, lists = stored
    dataset = data.load_dataset(path, num_steps=2, frameskip=3, backend="numpy")
    chunks = dataset.load_chunk(np.array([3, 0]), np.array([2, 0]), np.array([14, 6]))
    for chunk, (number, start, end) in zip(chunks, [(3, 2, 14), (0, 0, 6)], strict=True):
        expected = clips([{name: array[start:end] for name, array in written[number].items()}], (end - start) // 3, 3)
        same(chunk, expected[0], lists)
    assert dataset.load_chunk([1], [3], [3])[0]["action"].shape == (0, 6)
    loaded = dataset.load_episode(2)
    assert loaded["action"].shape == (9, 2) and loaded["state"].shape == (3, 4)
    for name in ("pixels", "action", "state"):
        np.testing.assert_array_equal(dataset.get_col_data(name), np.concatenate([e[name] for e in written]))
    rows = dataset.get_row_data([70, 12, 12])
    np.testing.assert_array_equal(rows["state"], [written[3]["state"][29], written[1]["state"][0], written[1]["state"][0]])
    assert dataset.get_row_data(-1)["pixels"].shape == (16, 16, 3)
    np.testing.assert_array_equal(dataset.get_col_data("episode_idx"), np.repeat(np.arange(4), LENGTHS))


def test_cached_and_merged_columns_have_the_stored_values(stored):
    path, written, _ = stored
    dataset = data.load_dataset(
        path, num_steps=2, keys_to_load=["pixels"], keys_to_cache=["pixels"], backend="numpy",
        keys_to_merge={"both": ["action", "state"], "actions": "act.*"},
    )  # fmt: skip
    expected = np.concatenate([written[0]["action"][:2], written[0]["state"][:2]], axis=1)
    for _ in range(2):
        sample = dataset[0]
        np.testing.assert_array_equal(sample["both"], expected)
        np.testing.assert_array_equal(sample["pixels"], written[0]["pixels"][:2].transpose(0, 3, 1, 2))
    assert dataset.column_names == ["pixels", "both", "actions"]
    assert dataset.get_dim("both") == 6


def test_merged_columns_replace_stored_ones_everywhere(stored, tmp_path):
    path, written, lists = stored
    keys = {"state": ["state", "action"], "twice": ["reward"]}
    dataset = data.load_dataset(path, num_steps=3, frameskip=2, backend="numpy", keys_to_merge=keys)
    assert dataset[0]["state"].shape == (3, 6)
    again = pickle.loads(pickle.dumps(dataset))
    for joined in (dataset, again, data.ConcatDataset([dataset, dataset]), data.MergeDataset([dataset])):
        batches = list(data.Loader(joined, 8, shuffle=False))
        assert set(batches[0]) == set(joined[0])
        for name in ("state", "twice", "action", "pixels"):
            found = np.concatenate([batch[name] for batch in batches])
            np.testing.assert_array_equal(found, [joined[i][name] for i in range(len(joined))])
    data.convert(dataset, tmp_path / "copy.h5", progress=False)
    copied = data.load_dataset(tmp_path / "copy.h5", backend="numpy")
    np.testing.assert_array_equal(copied.get_col_data("state"), dataset.get_col_data("state"))
    columns = {column["name"]: column["shape"] for column in data.inspect(dataset)["columns"]}
    assert columns["state"] == [6] and columns["twice"] == ([1] if lists else [])
    with pytest.raises(ValueError, match="have 142 rows, expected 71"):
        dataset.merge_col(["state", "state"], "long", dim=0)


def test_columns_are_copies(stored):
    path, *_ = stored
    dataset = data.load_dataset(path, backend="numpy", keys_to_cache=["reward"], keys_to_merge={"both": ["action", "state"]})
    for name in ("both", "state", "reward"):
        before = dataset[3][name].copy()
        column = dataset.get_col_data(name)
        column[:] = 100
        np.testing.assert_array_equal(dataset[3][name], before)
        assert (dataset.get_col_data(name) != 100).any()


def test_transform_gets_rows_before_frameskip_joins_actions(stored):
    path, _, _ = stored
    seen = []

    def transform(sample):
        seen.append(sample["action"].shape)
        return {**sample, "action": 2 * sample["action"]}

    plain = data.load_dataset(path, num_steps=3, frameskip=2, backend="numpy")
    dataset = data.load_dataset(path, num_steps=3, frameskip=2, backend="numpy", transform=transform)
    np.testing.assert_array_equal(dataset[4]["action"], 2 * plain[4]["action"])
    np.testing.assert_array_equal(dataset.__getitems__([4])[0]["action"], 2 * plain[4]["action"])
    assert seen == [(6, 2), (6, 2)]


def test_dataset_can_be_pickled(stored):
    path, written, lists = stored
    dataset = pickle.loads(pickle.dumps(data.load_dataset(path, num_steps=3, keys_to_cache=["pixels"], backend="numpy")))
    same(dataset[20], clips(written, 3, 1)[20], lists)


def test_wrong_arguments_raise_errors_with_the_reason(stored, tmp_path, monkeypatch):
    path, _, _ = stored
    with pytest.raises(KeyError, match="no column 'pixel'.*the columns are .*pixels"):
        data.load_dataset(path, keys_to_load=["pixel"])
    dataset = data.load_dataset(path, num_steps=2)
    with pytest.raises(IndexError, match="clip 67 is outside the dataset, which has 67 clips"):
        dataset[67]
    with pytest.raises(IndexError, match="rows 5 .. 13 are outside episode 0, which has 12 rows"):
        dataset.load_chunk([0], [5], [13])
    with pytest.raises(IndexError, match="episode 4 is outside the dataset, which has 4 episodes"):
        dataset.load_chunk([4], [0], [1])
    with pytest.raises(ValueError, match="'torch' or 'numpy', got 'jax'"):
        data.load_dataset(path, backend="jax")
    with pytest.raises(ValueError, match="unknown format 'zarr'"):
        data.load_dataset(path, format="zarr")
    with pytest.raises(ValueError, match="no multiples of frameskip 2"):
        data.load_dataset(path, frameskip=2).load_chunk([0], [0], [3])
    monkeypatch.setenv("STABLEWM_HOME", str(tmp_path))
    (tmp_path / "datasets").mkdir()
    write(tmp_path / "datasets" / "rooms.lance", (5,))
    with pytest.raises(FileNotFoundError, match="'roms'.*did you mean rooms"):
        data.load_dataset("roms")
    (tmp_path / "notes").mkdir()
    with pytest.raises(ValueError, match="of no known format"):
        data.load_dataset(tmp_path / "notes")


def test_dataset_names_are_resolved_in_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("STABLEWM_HOME", str(tmp_path))
    write("rooms", (5,))
    assert (tmp_path / "datasets" / "rooms.lance").exists()
    monkeypatch.chdir(tmp_path)
    for name in ("rooms", "rooms.lance"):
        assert data.load_dataset(name).lengths.tolist() == [5]
    monkeypatch.setenv("STABLEWM_HOME", str(tmp_path / "elsewhere"))
    assert data.load_dataset("rooms", cache_dir=tmp_path).lengths.tolist() == [5]


@pytest.mark.parametrize("name", ["", " ", "lerobot://"])
def test_an_empty_name_is_no_dataset(tmp_path, monkeypatch, name):
    write(tmp_path / "only.lance", (5,))
    (tmp_path / "datasets").mkdir()
    monkeypatch.chdir(tmp_path)
    for cache_dir in (None, tmp_path):
        with pytest.raises(ValueError, match="it is empty|names no repository"):
            data.load_dataset(name, cache_dir=cache_dir)


def test_numpy_backend_does_not_import_torch(stored):
    path, _, _ = stored
    program = (
        "import sys; from stable_worldmodel import data\n"
        f"dataset = data.load_dataset({str(path)!r}, backend='numpy')\n"
        "batch = next(iter(data.Loader(dataset, 4)))\n"
        "assert type(dataset[0]['pixels']).__name__ == 'ndarray' and batch['pixels'].shape[2] == 3\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_concatenated_and_merged_datasets_have_all_clips_and_columns(tmp_path):
    first, second = write(tmp_path / "a.lance", (8, 9)), write(tmp_path / "b.lance", (7,))
    parts = [data.load_dataset(tmp_path / f"{name}.lance", num_steps=3, frameskip=2, backend="numpy") for name in "ab"]
    both = data.ConcatDataset(parts)
    expected = clips(first + second, 3, 2)
    assert len(both) == len(expected)
    for found, clip in zip(both.__getitems__(range(len(both))), expected, strict=True):
        same(found, clip, True)
    same(both[-1], expected[-1], True)
    np.testing.assert_array_equal(both.get_row_data([17])["state"][0], second[0]["state"][0])
    none, rows = both.get_row_data([]), parts[0].get_row_data([])
    assert {name: (value.shape, value.dtype) for name, value in none.items()} == {
        name: (value.shape, value.dtype) for name, value in rows.items()
    }
    assert [len(chunk["state"]) for chunk in both.load_chunk([2, 0], [0, 0], [4, 8])] == [2, 4]
    assert both.lengths.tolist() == [8, 9, 7] and both.get_col_data("reward").shape == (24, 1)

    with data.open_writer(tmp_path / "c.lance") as writer:
        writer.write_episodes({"feature": 10.0 + content["state"], "state": content["state"]} for content in first)
    features = data.load_dataset(tmp_path / "c.lance", num_steps=3, frameskip=2, backend="numpy")
    merged = data.MergeDataset([parts[0], features])
    assert merged.column_names == [*parts[0].column_names, "feature"]
    for sample in (merged[2], merged.__getitems__([2])[0]):
        np.testing.assert_array_equal(sample["feature"], 10.0 + sample["state"])
    with pytest.raises(ValueError, match="same episodes"):
        data.MergeDataset([parts[0], parts[1]])
    # The first dataset has `state`, too, which `keys_from_dataset` takes from the second.
    chosen = data.MergeDataset([parts[0], features], [["action"], ["feature", "state"]])
    for dataset in (both, merged, chosen):
        batches = list(data.Loader(dataset, 4, shuffle=False, columns=["state", "action"], backend="numpy"))
        found = np.concatenate([batch["state"] for batch in batches])
        np.testing.assert_array_equal(found, [dataset[i]["state"] for i in range(len(dataset))])


def test_goal_probabilities_choose_current_later_and_random_steps(tmp_path):
    write(tmp_path / "a.lance")
    dataset = data.load_dataset(tmp_path / "a.lance", num_steps=2, frameskip=2, backend="numpy")
    keys = {"reward": "goal"}

    def drawn(chances, **kwargs):
        goals = data.GoalDataset(dataset, chances, goal_keys=keys, seed=3, **kwargs)
        samples = goals.__getitems__(range(len(goals)))
        # The reward counts rows, so the difference is the distance from the clip's last step to the goal in rows.
        return goals, np.array([sample["goal"][0, 0] - sample["reward"][-1, 0] for sample in samples])

    goals, ahead = drawn((0, 0, 0, 1))
    assert len(goals) == len(dataset) and (ahead == 0).all()
    goals, ahead = drawn((0, 0.5, 0.5, 0), gamma=0.5)
    assert len(goals) == sum(length - 2 - 2 for length in LENGTHS)
    assert (ahead >= 2).all() and (ahead % 2 == 0).all() and (ahead > 2).any()
    _, again = drawn((0, 0.5, 0.5, 0), gamma=0.5)
    np.testing.assert_array_equal(ahead, again)
    goals.set_epoch(1)
    later = np.array([sample["goal"][0, 0] - sample["reward"][-1, 0] for sample in goals.__getitems__(range(len(goals)))])
    assert (later != ahead).any()
    _, ahead = drawn((1, 0, 0, 0))
    assert (abs(ahead) > 30).any(), "some goals are in other episodes"
    assert goals.clip_indices[0] == (0, 0)
    with pytest.raises(ValueError, match="add up to 1"):
        data.GoalDataset(dataset, (1, 1, 0, 0))
    third = 0.333333
    goals, _ = drawn((third, third, third, 0))
    assert sum(goals.goal_probabilities) == pytest.approx(1, abs=1e-12)


def test_masks_and_fractions_are_no_indices(tmp_path):
    write(tmp_path / "a.lance")
    stored = data.load_dataset(tmp_path / "a.lance", backend="numpy")
    buffer = data.ReplayBuffer(100, sampler=lambda *_: [True, False, True])
    buffer.write_episodes(
        stored.load_episode(n) | {"pixels": np.zeros((length, 2, 2, 3), np.uint8)} for n, length in enumerate((12,))
    )
    for dataset in (stored, buffer, data.ConcatDataset([stored, stored])):
        for wrong in ([True, False, True], [0.9, 1.9]):
            with pytest.raises(TypeError, match="whole numbers, got (bool|float64); np.flatnonzero"):
                dataset.get_row_data(wrong)
            with pytest.raises(TypeError, match="whole numbers"):
                dataset.load_chunk(wrong, [0] * len(wrong), [1] * len(wrong))
            with pytest.raises(TypeError, match="whole numbers"):
                dataset[wrong[0]]
        assert dataset.get_row_data(np.flatnonzero([True, False, True]))["reward"].ravel().tolist() == [0, 2]
    with pytest.raises(TypeError, match="sampler: expected whole numbers, got bool"):
        buffer.sample(3)


class Counted(data.Dataset):
    """A user's dataset of one episode of 12 rows."""

    def __init__(self, **kwargs):
        super().__init__([12], [0], **kwargs)

    @property
    def column_names(self):
        return ["row", "action"]

    def _load_slice(self, ep_idx, start, end):
        return {"row": np.arange(start, end, self.frameskip), "action": np.arange(2 * start, 2 * end).reshape(-1, 2)}


def test_chunks_of_buffers_and_of_users_datasets_are_checked_as_those_of_stored_ones():
    buffer = data.ReplayBuffer(50, history_len=2, frameskip=2)
    buffer.write_episode({"row": np.arange(12), "action": np.arange(24).reshape(12, 2)})
    for dataset in (Counted(frameskip=2, num_steps=2), buffer):
        for index in (0, -1):
            (chunk,) = dataset.load_chunk([index], [2], [6])
            assert np.asarray(chunk["action"]).tolist() == [[4, 5, 6, 7], [8, 9, 10, 11]]
        for wrong, error, words in (
            ((0, 0, 5), ValueError, "no multiples of frameskip 2"),
            ((0, 10, 14), IndexError, "rows 10 .. 14 are outside episode 0, which has 12 rows"),
            ((0, -4, 4), IndexError, "rows -4 .. 4 are outside"),
            ((0, 6, 2), IndexError, "rows 6 .. 2 are outside"),
            ((5, 0, 4), IndexError, "episode 5 is outside the dataset, which has 1 episodes"),
            ((-13, 0, 4), IndexError, "episode -13 is outside the dataset, which has 1 episodes"),
        ):
            with pytest.raises(error, match=words):
                dataset.load_chunk(*([value] for value in wrong))


def test_chunks_are_given_as_sequences_of_one_length(tmp_path):
    with data.EpisodeWriter(tmp_path / "a.h5") as writer:
        writer.write_episode({"x": np.arange(12)})
    stored = data.load_dataset(str(tmp_path / "a.h5"))
    merged = data.MergeDataset([stored, Counted()], keys_from_dataset=[["x"], ["row"]])
    for dataset in (stored, Counted(), merged, data.ConcatDataset([stored, stored])):
        for wrong, shapes in ((([0, 0], [0], [2]), "(2,), (1,) and (1,)"), (([0], [0, 1], [2, 3]), "(1,), (2,) and (2,)")):
            with pytest.raises(ValueError, match="sequences of one length.*" + re.escape(shapes)):
                dataset.load_chunk(*wrong)
        with pytest.raises(ValueError, match="sequences of one length"):
            dataset.load_chunk(0, 0, 2)
        with pytest.raises(IndexError, match="-13"):
            dataset.load_chunk([-13], [0], [2])
        assert dataset.load_chunk([], [], []) == []


@pytest.mark.parametrize("kind", [data.MergeDataset, data.ConcatDataset])
def test_datasets_with_other_clips_are_not_joined(kind, tmp_path):
    for name in "ab":
        with data.EpisodeWriter(tmp_path / f"{name}.h5", mode="overwrite") as writer:
            writer.write_episode({name: np.arange(12)})
    loaded = [("a", 2, 3), ("b", 3, 2), ("b", 2, 1)]
    a, *others = (
        data.load_dataset(str(tmp_path / f"{name}.h5"), num_steps=steps, frameskip=skip) for name, steps, skip in loaded
    )
    for other in others:
        with pytest.raises(ValueError, match="the same num_steps and frameskip, got"):
            kind([a, other])


def test_merged_datasets_take_each_column_from_one_dataset(tmp_path):
    for name in "ab":
        with data.open_writer(tmp_path / f"{name}.h5") as writer:
            writer.write_episode({"x": np.arange(4.0) + (name == "b"), "action": np.zeros((3, 1), np.float32)})
    a, b = (data.load_dataset(tmp_path / f"{name}.h5", backend="numpy") for name in "ab")
    for keys, error, message in (
        ([["x", "action"], ["x"]], ValueError, "'x' would be taken twice"),
        ([["action"], ["nope", "x"]], KeyError, "dataset 1 has no column 'nope'; its columns are x, action"),
        ([["x"]], ValueError, "a list of columns for each of 2 datasets, got 1"),
    ):
        with pytest.raises(error, match=message):
            data.MergeDataset([a, b], keys)
    merged = data.MergeDataset([a, b], [["action"], ["x"]])
    assert merged[0]["x"] == merged.get_col_data("x")[0] == 1
    data.convert(data.MergeDataset([a, b], [["x"], []]), tmp_path / "c.h5", progress=False)
    assert data.load_dataset(tmp_path / "c.h5").column_names == ["x"], "only the columns that are chosen"


def test_goals_of_joined_datasets_are_rows_of_the_same_episode(tmp_path):
    for name, first in (("a", 0), ("b", 100)):
        with data.EpisodeWriter(tmp_path / f"{name}.h5", mode="overwrite") as writer:
            for episode in range(2):
                rows = first + 10 * episode + np.arange(6)
                writer.write_episode({"t": rows, "other": -rows})
    a, b = (data.load_dataset(str(tmp_path / f"{name}.h5"), num_steps=2) for name in "ab")
    for joined, clips_of_all in ((data.ConcatDataset([a, b]), 16), (data.MergeDataset([a, b], [["t"], ["other"]]), 8)):
        goals = data.GoalDataset(joined, (0.0, 0.5, 0.5, 0.0), goal_keys={"t": "goal_t", "other": "goal_other"}, seed=0)
        assert len(goals) == clips_of_all and len(set(goals.clip_indices)) == clips_of_all
        for sample in (goals[i] for i in range(len(goals))):
            ahead = int(sample["goal_t"][0]) - int(sample["t"][-1])
            assert 1 <= ahead <= 4 and int(sample["other"][-1]) - int(sample["goal_other"][0]) == ahead


def test_joined_datasets_follow_buffers_that_grow():
    def add(buffer, length, value):
        state = np.full((length, 1), value, np.float32)
        buffer.write_episode({"state": state, "action": np.zeros((length, 2), np.float32)})

    first, second = data.ReplayBuffer(200), data.ReplayBuffer(200)
    add(first, 5, 1)
    add(second, 7, 100)
    joined = data.ConcatDataset([first, second])
    goals = data.GoalDataset(joined, (0.0, 0.5, 0.5, 0.0), goal_keys={"state": "goal_state"}, seed=0)
    for length, value in ((6, 2), (4, 3)):
        add(first, length, value)
        expected = np.concatenate([np.asarray(part.get_col_data("state")) for part in (first, second)])[:, 0]
        assert joined.num_episodes == len(joined.lengths) and len(joined) == len(first) + len(second)
        assert np.asarray(joined.get_row_data(np.arange(len(expected)))["state"]).ravel().tolist() == expected.tolist()
        starts = joined.offsets
        for index, n in enumerate(joined.lengths.tolist()):
            rows = np.asarray(joined.load_episode(index)["state"]).ravel()
            assert len(rows) == n and (rows == expected[starts[index]]).all()
        samples = [goals[i] for i in range(len(goals))]
        assert all(float(sample["state"].ravel()[0]) == float(sample["goal_state"].ravel()[0]) for sample in samples)
        assert {float(sample["state"].ravel()[0]) for sample in samples} == set(expected.tolist())


def test_scalers_normalise_and_invert(tmp_path):
    write(tmp_path / "a.lance")
    dataset = data.load_dataset(tmp_path / "a.lance", num_steps=3, frameskip=2, backend="numpy")
    action = dataset.get_col_data("action")
    transform = pickle.loads(pickle.dumps(data.column_normalizer(dataset, "action", "action")))
    dataset.transform = transform
    finite = action[~np.isnan(action).any(axis=1)]
    expected = (action[:6] - finite.mean(axis=0)) / finite.std(axis=0)
    np.testing.assert_allclose(dataset[0]["action"], expected.reshape(3, 4), rtol=1e-6)
    batch = next(iter(data.Loader(dataset, 2, shuffle=False)))
    np.testing.assert_allclose(batch["action"][0], expected.reshape(3, 4), rtol=1e-6)
    for method in ("zscore", "percentile", "none"):
        scaler = data.get_scaler(method).fit(action)
        inner = np.median(finite, axis=0, keepdims=True)
        np.testing.assert_allclose(scaler.inverse_transform(scaler.transform(inner)), inner, rtol=1e-5, atol=1e-6)
    for wide in (np.int8([[-120], [120]]), np.int32([[-(2**31)], [2**31 - 1]]), np.float16([[-6e4], [6e4]])):
        scaler, true = data.PercentileScaler(10, 90).fit(wide), np.percentile(wide.astype(np.float64), [10, 90])
        np.testing.assert_allclose([scaler.q_low.item(), scaler.q_high.item()], true, rtol=1e-6)
    for scaler in (data.PercentileScaler(), data.ZScoreScaler()):
        with pytest.raises(ValueError, match="the values have masked ones"):
            scaler.fit(np.ma.array([[1.0], [1e9]], mask=[[False], [True]]))
        with pytest.raises(ValueError, match="expected real numbers, got complex128"):
            scaler.fit(np.array([[1j]]))
    clipped = data.PercentileScaler(10, 90).fit_transform(finite)
    assert clipped.min() == -1 and clipped.max() == 1
    with pytest.raises(ValueError, match="not fitted"):
        data.ZScoreScaler().transform(finite)
    with pytest.raises(ValueError, match="unknown scaler 'minmax'"):
        data.get_scaler("minmax")


def test_text_columns_become_constants(tmp_path):
    content = {**episode(0, 4), "scene": "<mujoco/>", "words": ["go"] * 4}
    with data.open_writer(tmp_path / "a.lance") as writer:
        writer.write_episode(content)
        with pytest.raises(TypeError, match="'words': text that changes"):
            writer.write_episode({**content, "words": ["go", "go", "stop", "stop"]})
    dataset = data.load_dataset(tmp_path / "a.lance")
    assert dataset.constants(0) == {"scene": b"<mujoco/>", "words": b"go"}
    assert "words" not in dataset.column_names


def test_columns_that_only_some_joined_datasets_have_are_counted_with_a_warning(tmp_path):
    for name, more in (("a.h5", {}), ("b.h5", {"z": np.arange(3.0)})):
        with data.open_writer(tmp_path / name) as writer:
            writer.write_episode({"x": np.arange(3.0), **more})
    joined = data.ConcatDataset([data.load_dataset(tmp_path / name, backend="numpy") for name in ("a.h5", "b.h5")])
    assert joined.get_col_data("x").tolist() == [0, 1, 2, 0, 1, 2]
    with pytest.warns(UserWarning, match="1 of 2 datasets have column 'z'"):
        assert joined.get_col_data("z").tolist() == [0, 1, 2]
    assert joined.get_row_data([3, 4])["z"].tolist() == [0, 1]
    for rows in ([0, 3], [3, 0]):
        with pytest.raises(KeyError, match="some rows have other columns"):
            joined.get_row_data(rows)


@pytest.mark.parametrize("backend", ["numpy", "torch"])
def test_joined_datasets_have_scalars_of_one_shape(tmp_path, backend):
    torch = pytest.importorskip("torch")
    paths = [tmp_path / name for name in ("a.lance", "b.h5")]
    content = {"action": np.zeros((7, 1), np.float32), "reward": np.arange(8.0), "state": np.zeros((8, 1))}
    for path in paths:
        with data.open_writer(path) as writer:
            writer.write_episode(content)
    listed, scalar = (data.load_dataset(path, num_steps=2, backend=backend) for path in paths)
    seen = []
    listed.transform = lambda sample: seen.extend(value.shape[1:] for value in sample.values()) or sample
    buffer = data.ReplayBuffer(100, history_len=2)
    merged = data.MergeDataset([listed, listed], [["reward", "action"], ["state"]])
    # Samples of a buffer are arrays.
    with_buffer = [[listed, buffer]] if backend == "numpy" else []
    for parts in ([listed, scalar], [scalar, merged], [listed, data.ConcatDataset([scalar, scalar])], *with_buffer):
        joined = data.ConcatDataset(parts)
        if buffer in parts:
            buffer.write_episode(content)
        first, last = joined[0], joined[len(joined) - 1]
        for sample in (first, last):
            shapes = {name: tuple(value.shape) for name, value in sample.items()}
            assert shapes == {"action": (2, 1), "reward": (2,), "state": (2, 1)}
        chunks = joined.load_chunk([0, 1], [0, 0], [4, 4])
        episodes = [joined.load_episode(index) for index in (0, -1)]
        for sample, length in ((chunks[0], 4), (chunks[1], 4), (episodes[0], 8), (episodes[1], 8)):
            assert np.array_equal(sample["reward"], content["reward"][:length]) and sample["state"].shape == (length, 1)
        rows = len(joined.get_col_data("reward"))
        assert joined.get_col_data("reward").shape == (rows,) and joined.get_col_data("state").shape == (rows, 1)
        found = joined.get_row_data([0, rows - 1])
        assert found["reward"].tolist() == [0, 7] and found["action"].shape == (2, 1) and found["state"].shape == (2, 1)
        assert np.shape(joined.get_row_data(0)["reward"]) == ()
        batches = torch.utils.data.DataLoader(joined, batch_size=5, shuffle=True)
        assert all(tuple(batch["reward"].shape) == (len(batch["action"]), 2) for batch in batches)
        assert all(batch["reward"].ndim == 2 for batch in data.Loader(joined, 5))
        goals = data.GoalDataset(joined, (1.0, 0.0, 0.0, 0.0), goal_keys={"reward": "goal"}, seed=0)
        assert {tuple(goals[i]["goal"].shape) for i in range(len(goals))} == {(1,)}
    assert set(seen) == {(1,)}, "transforms get the samples of their dataset"
    assert data.ConcatDataset([listed, listed])[0]["reward"].shape == (2, 1)
