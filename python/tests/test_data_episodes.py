"""Tests of an episode's own values, of merged datasets, and of videos of episodes."""

import copy
import json
import pickle

import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel.data import EPISODE_DATA_KEY


def episode(index, steps=4):
    values = {"seed": 100 + index, "goal": np.array([index, 0.5], np.float32), "task": f"task {index}"}
    pixels = np.full((steps, 16, 16, 3), 20 * index, np.uint8)
    return {"x": np.arange(steps, dtype=np.float32) + 10 * index, "pixels": pixels, EPISODE_DATA_KEY: values}


def written(path, indices=range(3), **more):
    with swm.data.open_writer(path, mode="overwrite", **more) as writer:
        writer.write_episodes(episode(index) for index in indices)
    return path


@pytest.mark.parametrize("suffix", ["lance", "h5"])
def test_values_of_episodes_are_stored(tmp_path, suffix):
    dataset = swm.data.load_dataset(written(tmp_path / f"a.{suffix}"), backend="numpy")
    assert sorted(dataset.episode_column_names) == ["goal", "seed", "task"]
    assert "seed" not in dataset.column_names and EPISODE_DATA_KEY not in dataset.column_names
    table = dataset.get_episode_data()
    assert table["seed"].tolist() == [100, 101, 102] and table["task"].tolist() == ["task 0", "task 1", "task 2"]
    assert table["goal"].dtype == np.float32 and table["goal"].tolist() == [[0, 0.5], [1, 0.5], [2, 0.5]]
    assert dataset.get_episode_data([2, 0])["seed"].tolist() == [102, 100]
    with pytest.raises(IndexError, match="episode 3"):
        dataset.get_episode_data([3])


def test_values_of_episodes_of_derived_datasets(tmp_path):
    one = swm.data.load_dataset(written(tmp_path / "a.lance"), backend="numpy")
    other = swm.data.load_dataset(written(tmp_path / "b.lance", [5]), backend="numpy")
    both = swm.data.ConcatDataset([one, other])
    assert both.get_episode_data()["seed"].tolist() == [100, 101, 102, 105]
    assert both.get_episode_data([3, 1])["seed"].tolist() == [105, 101] and "goal" in both.episode_column_names
    assert swm.data.GoalDataset(one, seed=0).get_episode_data([1])["seed"].tolist() == [101]
    buffer = swm.data.ReplayBuffer(max_steps=9)
    buffer.write_episodes(episode(index) for index in range(3))
    # The oldest episode was removed.
    assert buffer.get_episode_data()["seed"].tolist() == [101, 102]
    buffer.dump(tmp_path / "c.lance")
    assert swm.data.load_dataset(tmp_path / "c.lance").get_episode_data()["seed"].tolist() == [101, 102]
    assert swm.data.split_episode_data(episode(1))[1]["seed"] == 101
    assert sorted(swm.data.split_episode_data({"x": 1})[0]) == ["x"]


def test_episodes_are_named_by_whole_numbers(tmp_path):
    dataset = swm.data.load_dataset(written(tmp_path / "a.lance"), backend="numpy", num_steps=2)
    buffer = swm.data.ReplayBuffer(max_steps=100, history_len=2)
    buffer.write_episodes(episode(index) for index in range(3))
    goals = swm.data.GoalDataset(dataset, goal_keys={"x": "goal_x"}, seed=0)
    for wrong in ([True, False], 1.9):
        for call in (dataset.get_episode_data, buffer.get_episode_data, dataset.constants, goals.__getitems__):
            with pytest.raises(TypeError, match="whole numbers"):
                call(wrong)
    with pytest.raises(IndexError, match="episode 67"):
        buffer.get_episode_data([67])
    assert buffer.get_episode_data([-1])["seed"].tolist() == [102]
    for index in (2**64 - 1, np.uint64(2**64 - 3)):
        for call in (dataset.__getitem__, dataset.get_row_data, swm.data.ConcatDataset([dataset]).load_episode):
            with pytest.raises(IndexError, match="larger than any index"):
                call(index)
    for offset in (-5, 0):
        with pytest.raises(ValueError, match="counted from 1"):
            swm.data.GoalDataset(dataset, current_goal_offset=offset)
    with pytest.raises(TypeError, match="whole numbers"):
        swm.data.GoalDataset(dataset, current_goal_offset=1.5)


def test_current_steps_lie_in_the_episode_and_unknown_goal_columns_are_named(tmp_path):
    dataset = swm.data.load_dataset(written(tmp_path / "a.lance"), backend="numpy")
    # The current step is the third one from a clip's start: episodes of four rows have two such clips.
    current = {"goal_probabilities": (0, 0, 0, 1), "goal_keys": {"x": "goal_x"}}
    goals = swm.data.GoalDataset(dataset, current_goal_offset=3, **current)
    assert [float(sample["goal_x"].item()) for sample in goals] == [2, 3, 12, 13, 22, 23]
    with pytest.warns(UserWarning, match="replace the dataset's columns \\['pixels'\\]"):
        swm.data.GoalDataset(dataset, goal_keys={"x": "pixels"}, goal_probabilities=(1, 0, 0, 0))
    for anchor in (-1, 0.5):
        with pytest.raises(ValueError, match="Goals.anchor: .*; expected a whole number of at least 0"):
            swm.data.Loader(dataset, 2, goals=swm.data.Goals(columns=["x"], anchor=anchor))
    with pytest.raises(ValueError, match="the anchor of 'goal'.*7"):
        swm.data.Loader(dataset, 2, goals=swm.data.Goals(columns=["x"], anchor=7))
    with pytest.warns(UserWarning, match="no \\['y'\\]"):
        assert "goal_y" not in swm.data.GoalDataset(dataset, goal_keys={"y": "goal_y"}, goal_probabilities=(1, 0, 0, 0))[0]


@pytest.mark.parametrize(
    "item",
    [
        {"dtype": "U250000000", "values": ["x"]},
        {"dtype": "O", "values": [1]},
        {"dtype": "uint8", "values": [1.7]},
        {"dtype": "uint8", "values": [300]},
        {"dtype": "float32", "values": [[1], [2, 3]]},
        {"dtype": "float32", "values": {"a": 1}},
        {"dtype": ["f4"], "values": [1]},
        [1, 2],
    ],
)
def test_values_of_a_foreign_file_have_their_type(tmp_path, item):
    writer = swm._engine.Writer(str(tmp_path / "a.lance"), "lance", "error", None, [("x", "float64", [])], None)
    writer.write({"x": np.arange(4.0)}, {EPISODE_DATA_KEY: json.dumps({"a": item})})
    writer.finish()
    with pytest.raises(ValueError, match="episode_data"):
        swm.data.load_dataset(tmp_path / "a.lance").get_episode_data()


def test_texts_of_a_buffer_stay_in_dumps_and_copies(tmp_path):
    buffer = swm.data.ReplayBuffer(max_steps=100)
    buffer.write_episode({**episode(1), "scene": "<mujoco/>"})
    for copied in (pickle.loads(pickle.dumps(buffer)), copy.copy(buffer)):
        assert copied.engine.constants(0)["scene"] == b"<mujoco/>" and copied.get_episode_data()["seed"].tolist() == [101]
    buffer.dump(tmp_path / "a.lance")
    assert swm.data.load_dataset(tmp_path / "a.lance").constants(0)["scene"] == b"<mujoco/>"


def test_long_texts_of_episodes_are_not_padded():
    table = swm.data._tensors.episode_table([{"task": "a" * 2**23}, {"task": "b"}, {"task": "c"}])["task"]
    assert table.dtype == object and table[1:].tolist() == ["b", "c"]
    assert swm.data._tensors.episode_table([{"task": "a"}, {"task": "b"}])["task"].dtype.kind == "U"


def test_rows_beyond_an_episode_take_no_memory(tmp_path):
    dataset = swm.data.load_dataset(written(tmp_path / "a.lance"), backend="numpy")
    for start, length in ((0, 2**40), (2, 3), (2**62, 2**62)):
        with pytest.raises(ValueError, match="rows of its 4"):
            dataset.engine.read(["x"], *(np.array([value]) for value in (0, start, length)), 1)


def test_merge_writes_all_episodes(tmp_path):
    sources = [written(tmp_path / "a.lance"), written(tmp_path / "b.h5", [7])]
    outcome = swm.data.merge(sources, tmp_path / "c.lance", progress=False)
    assert outcome["episodes"] == 4
    merged = swm.data.load_dataset(tmp_path / "c.lance", backend="numpy")
    assert merged.lengths.tolist() == [4] * 4
    assert merged.get_col_data("x").reshape(4, 4)[:, 0].tolist() == [0, 10, 20, 70]
    with pytest.raises(ValueError, match="exists already"):
        swm.data.merge(sources, tmp_path / "c.lance", progress=False)
    with pytest.raises(ValueError, match="list of datasets"):
        swm.data.merge(str(sources[0]), tmp_path / "d.lance")


def test_videos_of_episodes(tmp_path):
    dataset = swm.data.load_dataset(written(tmp_path / "a.lance"))
    swm.utils.record_video_from_dataset(tmp_path / "videos", dataset, [0, 2], max_steps=3, viewname=["pixels", "pixels"])
    assert sorted(path.name for path in (tmp_path / "videos").iterdir()) == ["episode_0.mp4", "episode_2.mp4"]
    frames = np.random.default_rng(0).integers(0, 255, (5, 32, 48, 3), np.uint8)
    swm.plot.save_video(tmp_path / "noise.mp4", frames, fps=10)
    data = (tmp_path / "noise.mp4").read_bytes()
    assert data[4:8] == b"ftyp" and len(data) > 1000
    swm.plot.save_panel_videos(tmp_path / "panels", {"played": [frames], "goal": [frames[0]]})
    assert (tmp_path / "panels" / "env_0.mp4").stat().st_size > 1000
    with pytest.raises(ValueError, match="uint8"):
        swm.plot.save_video(tmp_path / "bad.mp4", frames.astype(np.float32))
    with pytest.raises(ValueError, match="videos are MP4 files"):
        swm.plot.save_video(tmp_path / "bad.gif", frames)
    for fps in (0, -5, np.nan):
        with pytest.raises(ValueError, match="fps: .*; expected"):
            swm.plot.save_video(tmp_path / "bad.mp4", frames, fps=fps)
    for panels in ({}, {"a": [frames], "b": [frames, frames]}):
        with pytest.raises(ValueError, match="panels: they have the environments .*; give at least one"):
            swm.plot.save_panel_videos(tmp_path / "panels", panels)
    dataset = swm.data.load_dataset(written(tmp_path / "v.lance"))
    swm.utils.record_video_from_dataset(tmp_path / "recorded", dataset, np.int64(-1))
    assert [path.name for path in (tmp_path / "recorded").iterdir()] == ["episode_2.mp4"]
    with pytest.raises(IndexError, match="episode_idx: 3; the dataset has 3 episodes"):
        swm.utils.record_video_from_dataset(tmp_path / "recorded", dataset, [0, 3])
    with pytest.raises(ValueError, match="nothing"):
        swm.utils.record_video_from_dataset(tmp_path, dataset, 0, viewname="nothing")


def test_datasets_take_the_arguments_of_the_reference(tmp_path):
    written(tmp_path / "a.h5")
    dataset = swm.data.HDF5Dataset("a", 1, 2, None, ["x"], None, None, None, tmp_path / "a.h5")
    assert len(dataset) == 9 and dataset.column_names == ["x"] and not dataset.is_remote
    with swm.data.LanceWriter(tmp_path, "table", mode="overwrite") as writer:
        writer.write_episode(episode(1))
    assert len(swm.data.LanceDataset(tmp_path, "table", num_steps=4)) == 1
    with swm.data.VideoWriter(tmp_path / "video", 30, "libx264", mode="overwrite") as writer:
        writer.write_episode(episode(1))
    assert swm.data.VideoDataset(path=tmp_path / "video", num_steps=2)[0]["x"].shape[0] == 2
    outcome = swm.data.convert(tmp_path / "a.h5", tmp_path / "v2", dest_format="video", fps=30, progress=False)
    assert outcome["episodes"] == 3


def test_functions_of_utils():
    from stable_worldmodel import utils

    assert utils.flatten_dict({"a": {"b": 1, "c": {"d": 2}}, "e": 3}) == {"a.b": 1, "a.c.d": 2, "e": 3}
    assert utils.flatten_dict({"a": {"b": 1}}, "x", "/") == {"x/a/b": 1}
    assert utils.get_in({"a": [{"b": 5}]}, ["a", 0, "b"]) == 5 and utils.default(0, 7) == 0 and utils.default(None, 7) == 7
    with pytest.raises(ValueError, match="missing.py"):
        utils.pretraining("missing.py", "data", "model")
