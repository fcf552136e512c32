"""Tests of writing episodes, native and user-defined formats, conversion and examination."""

import json
import pickle
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from data_helpers import episode, episodes, same, write

import stable_worldmodel as swm
from stable_worldmodel import data


@pytest.mark.parametrize("name", ["a.lance", "a.h5"])
def test_write_modes_append_replace_or_fail(tmp_path, name):
    path = tmp_path / name
    write(path, (5, 6))
    write(path, (7,))
    assert data.load_dataset(path).lengths.tolist() == [5, 6, 7]
    with pytest.raises(FileExistsError, match="there is a dataset already"):
        write(path, (5,), mode="error")
    write(path, (4,), mode="overwrite")
    assert data.load_dataset(path).lengths.tolist() == [4]
    with pytest.raises(ValueError, match="mode: expected one of append, overwrite, error, got 'replace'"):
        write(path, (5,), mode="replace")


class Broken(gymnasium.Env):
    """Fails at its first step after a reset of an episode."""

    observation_space = action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    metadata = {"render_modes": ["rgb_array"]}
    steps = 0

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.steps > 1:  # The first step is the one that determines the columns.
            raise RuntimeError("the robot fell over")
        return np.zeros(1, np.float32), 0.0, False, False, {}


gymnasium.register("Broken-v0", Broken, max_episode_steps=5)


@pytest.mark.parametrize("name", ["a.lance", "a.h5", "folder"])
def test_a_dataset_to_overwrite_stays_until_an_episode_is_accepted(tmp_path, name):
    path, format = tmp_path / name, None if "." in name else "folder"
    write(path, (5, 6), format=format)

    def lengths():
        return data.load_dataset(path, format=format).lengths.tolist()

    with pytest.raises(ValueError, match="row 0"), data.open_writer(path, format=format, mode="overwrite") as writer:
        writer.write_episode({**episode(0, 4), "action": np.full((4, 2), np.nan, np.float32)})
    assert lengths() == [5, 6]
    world = swm.World("Broken-v0", num_envs=1, image_shape=(16, 16))
    with pytest.raises(RuntimeError, match="fell over"):
        world.collect(path, episodes=2, format=format, mode="overwrite", policy=swm.policy.RandomPolicy(), progress=False)
    assert lengths() == [5, 6]
    with data.open_writer(path, format=format, mode="overwrite") as writer:
        with pytest.raises(ValueError, match="row 0"):
            writer.write_episode({**episode(0, 4), "action": np.full((4, 2), np.nan, np.float32)})
        writer.write_episode(episode(0, 4))
    assert lengths() == [4]


@pytest.mark.parametrize("mode", ["append", "overwrite"])
def test_an_interrupted_overwrite_is_undone_before_a_writer_opens(tmp_path, mode):
    path = tmp_path / "folder"
    write(path, (5, 6), format="folder")
    # A kill before the first commit of an overwrite leaves the old dataset here.
    old = path / "ep_len.replaced"
    for file in [file for file in path.rglob("*") if file.is_file()]:
        moved = old / file.relative_to(path)
        moved.parent.mkdir(parents=True, exist_ok=True)
        file.rename(moved)
    with pytest.raises(RuntimeError, match="being replaced"):
        data.load_dataset(path, format="folder")
    write(path, (4,), format="folder", mode=mode)
    assert data.load_dataset(path, format="folder").lengths.tolist() == ([5, 6, 4] if mode == "append" else [4])
    assert not old.exists()


def test_dump_keeps_the_old_dataset_if_an_episode_is_refused(tmp_path):
    path = tmp_path / "a.lance"
    write(path, (5, 6))
    buffer = data.ReplayBuffer(100)
    buffer.write_episode({"action": np.zeros((3, 1), np.float32), "x": np.full(4, 2**24 + 1)})
    with pytest.raises(ValueError, match="x"):
        buffer.dump(path)
    assert data.load_dataset(path).lengths.tolist() == [5, 6]


def test_lists_and_small_types_are_converted(tmp_path):
    path = tmp_path / "a.lance"
    given = {
        "pixels": [np.full((8, 8, 3), step, dtype=np.uint8) for step in range(4)],
        "action": [[0.0, 1.0]] * 3,
        "half": np.ones(4, dtype=np.float16),
        "small": np.arange(4, dtype=np.int8),
        "step_idx": [9, 10, 11, 12],
    }
    with data.open_writer(path) as writer:
        writer.write_episode(given)
        assert writer.num_episodes == 1
    dataset = data.load_dataset(path, num_steps=4, backend="numpy")
    sample = dataset[0]
    assert np.isnan(sample["action"][3]).all() and (sample["action"][:3] == [0, 1]).all()
    assert sample["half"].dtype == np.float32 and sample["small"].dtype == np.int32
    assert dataset.get_col_data("step_idx").tolist() == [0, 1, 2, 3], "the writer computes the indices"


@pytest.mark.parametrize("dtype", ["uint8", "bool"])
def test_missing_actions_are_not_invented(tmp_path, dtype):
    path = tmp_path / "a.lance"
    content = {"x": np.arange(4.0), "action": np.ones(3, dtype)}
    with data.open_writer(path) as writer:
        for target in (writer, data.ReplayBuffer(100)):
            with pytest.raises(ValueError, match=f"3 actions of 4 steps, .* {dtype} has no value .*; convert the actions"):
                target.write_episode(content)
        with pytest.warns(UserWarning, match="the action of an episode's last row is stored"):
            writer.write_episode({**content, "action": np.ones(4, dtype)})
    assert data.load_dataset(path).get_col_data("action").ravel().tolist() == [1, 1, 1, 1]


@pytest.mark.parametrize("format", ["lance", "hdf5", "folder", "lerobot"])
@pytest.mark.parametrize(
    "actions", [np.array([5, 6, 7, 8], np.uint8), np.array([True, True, True, False]), np.array([9], np.uint8)]
)
def test_last_actions_of_types_without_a_missing_value_are_kept(tmp_path, format, actions):
    content = {"x": np.arange(len(actions), dtype=np.float32), "action": actions}
    with pytest.warns(UserWarning, match="is stored"), data.open_writer(tmp_path / "a", format=format) as writer:
        writer.write_episode(content)
    assert data.load_dataset(tmp_path / "a", format=format).get_col_data("action").ravel().tolist() == actions.tolist()


@pytest.mark.parametrize("mode", ["append", "overwrite"])
@pytest.mark.parametrize("name", ["a.lance", "a.h5", "a"])
def test_threads_share_a_writer(tmp_path, name, mode):
    format = None if "." in name else "folder"
    for trial in range(4):
        path = tmp_path / f"{trial}" / name
        write(path, (5,), format=format)
        # A writer that has written nothing can be pickled.
        writer = pickle.loads(pickle.dumps(data.open_writer(path, format=format, mode=mode)))
        together = threading.Barrier(6)

        def write_one(number, writer=writer, together=together):
            together.wait()
            writer.write_episode(episode(number, 6 + number))

        with writer, ThreadPoolExecutor(6) as threads:
            list(threads.map(write_one, range(6)))
        lengths = data.load_dataset(path, format=format).lengths.tolist()
        assert sorted(lengths) == [5] * (mode == "append") + [6, 7, 8, 9, 10, 11]


@pytest.mark.parametrize("name", ["a.h5", "a.lance", "a"])
def test_values_that_the_stored_type_cannot_hold_are_refused(tmp_path, name):
    path = tmp_path / name
    format = None if "." in name else "folder"

    def write(values, **kwargs):
        with data.open_writer(path, format=format, **kwargs) as writer:
            writer.write_episode({"action": np.zeros((2, 1), np.float32), "x": np.array(values)[:, None]})

    for value in (2**63, 2**64 - 1):
        with pytest.raises(ValueError, match=f"column 'x': {value} is stored as int64"):
            write(np.array([1, value, 2], np.uint64), mode="overwrite")
    write(np.array([1, 2, 3], np.int32), mode="overwrite")
    for wrong, kind in ((2**31, np.int64), (-(2**33), np.int64), (2**32 - 1, np.uint32)):
        with pytest.raises(ValueError, match=f"column 'x': {wrong} is stored as int32"):
            write(np.array([1, wrong, 3], kind), mode="append")
    write(np.array([4, 5, 6], np.int64), mode="append")
    assert data.load_dataset(path, backend="numpy").get_col_data("x").ravel().tolist() == [1, 2, 3, 4, 5, 6]
    write(np.array([1, 2, 3], np.float32), mode="overwrite")
    for wrong in (np.array([0, 1e300, 0]), np.array([0, 2**30 + 1, 0])):
        with pytest.raises(ValueError, match="which cannot hold it"):
            write(wrong, mode="append")
    write(np.array([np.nan, np.inf, 0.1]), mode="append")


def test_replay_buffers_refuse_integers_that_do_not_fit():
    buffer = data.ReplayBuffer(max_steps=10)
    with pytest.raises(ValueError, match=f"column 'x': {2**63} is stored as int64"):
        buffer.write_episode({"action": np.zeros((1, 1), np.float32), "x": np.array([[1], [2**63]], np.uint64)})


def test_missing_discrete_action_is_stored_as_minus_one(tmp_path):
    with data.open_writer(tmp_path / "a.lance") as writer:
        writer.write_episode({"action": np.array([2, 0]), "state": np.zeros((3, 1))})
    assert data.load_dataset(tmp_path / "a.lance").get_col_data("action").ravel().tolist() == [2, 0, -1]


def test_invalid_episodes_are_rejected_and_valid_ones_stored(tmp_path):
    path = tmp_path / "a.lance"
    valid = episode(0, 5)
    cases = [
        ({**valid, "state": np.zeros((4, 4))}, ValueError, "same number of steps"),
        ({name: array for name, array in valid.items() if name != "reward"}, ValueError, r"missing \['reward'\]"),
        ({**valid, "extra": np.zeros(5)}, ValueError, r"unexpected \['extra'\]"),
        ({**valid, "state": np.zeros((5, 3))}, ValueError, r"steps of shape \(3,\), expected \(4,\) as in the dataset"),
        ({**valid, "terminated": np.zeros(5)}, TypeError, "'terminated' is float64, expected bool as in the dataset"),
        ({**valid, "state": np.zeros((5, 4), complex)}, TypeError, "complex128 cannot be stored"),
        ({**valid, "state": [np.zeros(4), np.zeros(3)]}, ValueError, "'state': its steps differ in shape"),
        ({**valid, "state": np.ma.masked_less(np.ones((5, 4)), 2)}, ValueError, "'state': it has masked values"),
        ({}, ValueError, "at least one numeric column"),
    ]
    with data.open_writer(path) as writer:
        writer.write_episode(valid)
        for broken, kind, message in cases:
            with pytest.raises(kind, match=message):
                writer.write_episode(broken)
        writer.write_episode(valid)
    with pytest.raises(ValueError, match="the writer is closed"):
        writer.write_episode(valid)
    assert data.load_dataset(path).lengths.tolist() == [5, 5]
    with pytest.raises(RuntimeError, match="stop here"), data.open_writer(path) as writer:
        writer.write_episode(valid)
        raise RuntimeError("stop here")
    assert data.load_dataset(path).num_episodes == 3
    with pytest.raises(ValueError, match="unexpected"), data.open_writer(path) as writer:
        writer.write_episode({**valid, "other": np.zeros(5)})
    with pytest.raises(ValueError, match="column 'step_idx': its values would be lost"), data.open_writer(path) as writer:
        writer.write_episode({**valid, "step_idx": np.arange(5) + 0.5})


def test_lossless_codecs_are_exact(tmp_path):
    with pytest.raises(TypeError, match="codec: expected"):
        data.open_writer(tmp_path / "a.lance", codec=5)
    sizes = {}
    for codec in (None, "qoi", "png", "jpeg", "jpeg-20"):
        path = tmp_path / f"{codec}.lance"
        written = write(path, (6,), codec=codec)
        error = np.abs(data.load_dataset(path).get_col_data("pixels").astype(int) - written[0]["pixels"]).max()
        assert (error == 0) == ("jpeg" not in str(codec))
        sizes[codec] = data.inspect(path)["footprint"]["pixels"]
    assert sizes["jpeg-20"] < sizes["jpeg"]
    for wrong in ("webp", "png-3", "jpeg-high"):
        with pytest.raises(ValueError, match="codec: expected"):
            data.open_writer(tmp_path / "b.lance", codec=wrong)
    assert data.LanceWriter(tmp_path / "c.lance", jpeg_quality=80).format == "lance"


def test_formats_without_codecs_refuse_jpeg(tmp_path):
    write(tmp_path / "a.lance", (6,))
    world = swm.World("swm/TwoRoom-v1", num_envs=1, image_shape=(32, 32), max_episode_steps=2)
    for call in (
        lambda codec: write(tmp_path / "b.h5", (6,), codec=codec),
        lambda codec: data.convert(tmp_path / "a.lance", tmp_path / "c.h5", codec=codec, progress=False),
        lambda codec: world.collect(tmp_path / "d.h5", 1, policy=swm.policy.RandomPolicy(), codec=codec, progress=False),
    ):
        with pytest.raises(ValueError, match="the format hdf5 stores images without loss; leave it out"):
            call("jpeg-90")
        call("png")


@pytest.fixture
def numpy_format():
    """A format that stores each episode in a `.npz` file."""

    class Reader(data.Dataset):
        def __init__(self, path, **kwargs):
            self.files = sorted(Path(path).glob("*.npz"))
            lengths = [len(np.load(file)["action"]) for file in self.files]
            super().__init__(lengths, np.cumsum([0, *lengths[:-1]]), **kwargs)

        @property
        def column_names(self):
            return list(np.load(self.files[0]))

        def _load_slice(self, ep_idx, start, end):
            sample = {}
            for name, array in np.load(self.files[ep_idx]).items():
                array = array[start:end] if name == "action" else array[start : end : self.frameskip]
                sample[name] = array.transpose(0, 3, 1, 2) if array.ndim == 4 else array
            return self.transform(sample) if self.transform else sample

    class Writer:
        def __init__(self, path, mode="append"):
            self.path = Path(path)
            if mode == "error" and self.path.exists():
                raise FileExistsError(path)

        def __enter__(self):
            self.path.mkdir(parents=True, exist_ok=True)
            return self

        def __exit__(self, *exc):
            pass

        def write_episode(self, ep_data):
            np.savez(self.path / f"{len(list(self.path.iterdir())):05}.npz", **ep_data)

        def write_episodes(self, episodes):
            for content in episodes:
                self.write_episode(content)

    @data.register_format
    class Npz(data.Format):
        name = "npz"

        @classmethod
        def detect(cls, path):
            return str(path).endswith(".npzs")

        @classmethod
        def open_reader(cls, path, **kwargs):
            return Reader(path, **kwargs)

        @classmethod
        def open_writer(cls, path, **kwargs):
            return Writer(path, **kwargs)

    yield Npz
    del data.FORMATS["npz"]


def test_texts_with_half_of_a_surrogate_pair_are_named(tmp_path):
    class Named:
        type = "mine\udcff"

        def get_action(self, infos):
            return np.zeros((1, 2), np.float32)

    wrong = {**episode(0, 5), "scene": "a room\udcff"}
    with data.open_writer(tmp_path / "a.lance") as writer:
        for write_to in (writer, data.ReplayBuffer(100)):
            with pytest.raises(ValueError, match=r"column 'scene': 'a room\\udcff' has half of a surrogate pair"):
                write_to.write_episode(wrong)
            write_to.write_episode({**wrong, "scene": "a room \U0001f600"})
    with swm.World("swm/TwoRoom-v1", add_pixels=False, max_episode_steps=3) as world:
        for play in (partial(world.collect, tmp_path / "b.lance"), partial(world.evaluate, floor=False)):
            with pytest.raises(ValueError, match=r"World\.(collect|evaluate): .*mine\\udcff.* has half of a surrogate pair"):
                play(episodes=1, policy=Named(), progress=False)


def test_user_defined_format_is_read_written_and_converted(tmp_path, numpy_format):
    assert data.get_format("npz") is numpy_format and "npz" in data.list_formats()
    assert data.detect_format(tmp_path / "x.npzs") is numpy_format
    written = write(tmp_path / "a.npzs")
    dataset = data.load_dataset(tmp_path / "a.npzs", num_steps=3, frameskip=2)
    assert dataset[0]["pixels"].shape == (3, 3, 16, 16) and dataset[0]["action"].shape == (3, 4)
    # Conversion to Lance and back.
    report = data.convert(tmp_path / "a.npzs", tmp_path / "b.lance", progress=False)
    assert report["episodes"] == 4 and all(column["exact"] for column in report["columns"])
    report = data.convert(tmp_path / "b.lance", tmp_path / "c", dest_format="npz", progress=False)
    assert report == {"episodes": 4, "rows": 71}
    back = data.load_dataset(tmp_path / "c", format="npz")
    for index, content in enumerate(written):
        found = back.load_episode(index)
        same({**found, "pixels": found["pixels"].transpose(0, 2, 3, 1)}, content)
    with pytest.raises(FileExistsError):
        data.convert(tmp_path / "b.lance", tmp_path / "c", dest_format="npz", progress=False)
    # Evaluations start from rows that the engine reads.
    with swm.World("swm/TwoRoom-v1", add_pixels=False) as world:
        world.set_policy(swm.policy.RandomPolicy())
        for given, error in ((tmp_path / "a.npzs", ValueError), (dataset, TypeError)):
            with pytest.raises(error, match="a format of the engine.*swm.data.convert"):
                world.evaluate(dataset=given, episodes=1, progress=False)
    # The loader returns the same batches from both formats.
    npz_loader = data.Loader(dataset, 8, backend="numpy")
    lance_loader = data.Loader(tmp_path / "b.lance", 8, num_steps=3, frameskip=2, columns=dataset.column_names, backend="numpy")
    for a, b in zip(npz_loader, lance_loader, strict=True):
        np.testing.assert_array_equal(a["pixels"], b["pixels"])
        np.testing.assert_array_equal(a["action"], b["action"])
    assert (
        data.inspect(tmp_path / "a.npzs", checksum=True)["checksum"]
        == data.inspect(data.load_dataset(tmp_path / "c", format="npz"), checksum=True)["checksum"]
    )


def test_conversion_warns_of_texts_that_a_user_defined_format_loses(tmp_path, numpy_format):
    content = {"state": np.zeros((4, 2)), "action": np.zeros((3, 1)), "words": "go", data.EPISODE_DATA_KEY: {"mass": 2.5}}
    with data.open_writer(tmp_path / "a.h5") as writer:
        writer.write_episodes([episode(0, 4), episode(1, 4) | {"words": "go"}])

    def converted(source, dest, names):
        with pytest.warns(UserWarning, match=f"{dest}: {names} are left out"):
            report = data.convert(source, tmp_path / dest, progress=False)
        return report

    assert converted(tmp_path / "a.h5", "b.npzs", "words") == {"episodes": 2, "rows": 8}

    class Reader:
        lengths = (4, 4)

        def load_episode(self, index):
            return content if index else {name: content[name] for name in ("state", "action")}

    report = converted(Reader(), "c.lance", "episode_data, words")
    assert report["episodes"] == 2
    assert converted(Reader(), "d.npzs", "episode_data, words") == {"episodes": 2, "rows": 8}
    # Conversions that lose nothing do not warn.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data.convert(tmp_path / "a.h5", tmp_path / "e.lance", progress=False)
        data.convert(tmp_path / "b.npzs", tmp_path / "f.lance", progress=False)
    assert data.load_dataset(tmp_path / "e.lance").constants(1) == {"words": b"go"}


def test_collection_in_a_user_defined_format_continues(tmp_path, numpy_format, monkeypatch):
    world = swm.World("swm/TwoRoom-v1", num_envs=2, add_pixels=False, image_shape=None, max_episode_steps=6)

    def collected(path, mode, episodes):
        policy = swm.policy.RandomPolicy(1)
        return world.collect(path, policy=policy, episodes=episodes, seed=1, mode=mode, progress=False)

    for mode, count, stored, added in (("resume", 3, 3, 3), ("resume", 5, 5, 2), ("resume", 4, 5, 0), ("append", 2, 7, 2)):
        counts = collected(tmp_path / "a.npzs", mode, count)
        assert counts == {"episodes": stored, "added": added, "steps": 6 * added}
    collected(tmp_path / "b.lance", "error", 7)
    own, native = data.load_dataset(tmp_path / "a.npzs"), data.load_dataset(tmp_path / "b.lance", backend="numpy")
    for i in range(7):
        np.testing.assert_array_equal(own.load_episode(i)["state"], native.load_episode(i)["state"])

    with pytest.raises(FileExistsError, match="do not resume; add to it"):
        data.convert(tmp_path / "b.lance", tmp_path / "a.npzs", progress=False)
    with pytest.raises(ValueError, match="convert: codec, least_psnr: the format 'npz' is user-defined"):
        data.convert(tmp_path / "b.lance", tmp_path / "c.npzs", codec="jpeg", least_psnr=30, progress=False)
    for mode, count in (("resume", 7), ("append", 14)):
        data.convert(tmp_path / "b.lance", tmp_path / "c.npzs", mode=mode, progress=False)
        assert len(data.load_dataset(tmp_path / "c.npzs").lengths) == count
    # A name that is no path, and a format without a reader.
    stored, reader, writer = tmp_path / "named.npzs", numpy_format.open_reader, numpy_format.open_writer
    with monkeypatch.context() as named:
        named.setattr(numpy_format, "open_reader", lambda path, **kwargs: reader(stored, **kwargs))
        named.setattr(numpy_format, "open_writer", lambda path, **kwargs: writer(stored, **kwargs))
        for mode, count in (("error", 7), ("append", 14)):
            data.convert(tmp_path / "b.lance", "a name", dest_format="npz", mode=mode, progress=False)
            assert len(reader(stored).lengths) == count
    with monkeypatch.context() as written:
        written.delattr(numpy_format, "open_reader")
        data.convert(tmp_path / "b.lance", tmp_path / "d.npzs", progress=False)
    # The writer adds to the folder, whatever the mode.
    with pytest.raises(
        RuntimeError, match="was given 7 episodes of 49 rows, and stored 21 episodes of 147 rows; correct the writer"
    ):
        data.convert(tmp_path / "b.lance", tmp_path / "c.npzs", mode="overwrite", progress=False)

    def unreadable(path, **kwargs):
        raise NotImplementedError("the format cannot be read")

    def incomplete(path, **kwargs):
        raise FileNotFoundError(f"{path}/lengths.npy")

    # The user's writer would add to the folder, whatever the mode.
    with pytest.raises(FileExistsError, match="there is a dataset already; add to it"):
        collected(tmp_path / "a.npzs", "error", 1)
    monkeypatch.setattr(numpy_format, "open_reader", incomplete)
    with pytest.raises(ValueError, match="does not tell the number of episodes .*lengths.npy.*cannot resume"):
        collected(tmp_path / "a.npzs", "resume", 9)
    (tmp_path / "empty.npzs").mkdir()
    assert collected(tmp_path / "empty.npzs", "resume", 2)["added"] == 2
    monkeypatch.setattr(numpy_format, "open_reader", unreadable)
    with pytest.raises(ValueError, match="does not tell the number of episodes .the format cannot be read., .*cannot resume"):
        collected(tmp_path / "a.npzs", "resume", 9)
    with pytest.warns(UserWarning, match="starts again with its first episode; use another seed"):
        collected(tmp_path / "a.npzs", "append", 1)


class Given:
    """A reader of the user with given lengths and episodes."""

    def __init__(self, lengths, load_episode, path=None):
        self.lengths, self.load_episode, self.path = lengths, load_episode, path


def test_a_user_defined_source_is_not_its_target(tmp_path, numpy_format, monkeypatch):
    source, link = tmp_path / "held" / "a.npzs", tmp_path / "link.npzs"
    source.parent.mkdir()
    write(source, (5, 6))
    write(tmp_path / "b.lance", (4,))
    link.symlink_to(source)
    opened = data.load_dataset(source)
    own = Given([5], lambda index: episode(0, 5), str(link))
    merged = partial(data.merge, [tmp_path / "b.lance", source])
    for read in (partial(data.convert, source), partial(data.convert, opened), partial(data.convert, own), merged):
        for target in (source, link, source.parent):
            for mode in ("resume", "append", "overwrite", "error"):
                with pytest.raises(ValueError, match=r"is, or holds, the dataset that is read \(.*\); give"):
                    read(target, dest_format="npz", mode=mode, progress=False)
    # A dataset of the engine, and a user's dataset behind a format of the engine.
    for read, target, format in ((tmp_path / "b.lance", tmp_path / "b.lance", "npz"), (source, source, "folder")):
        with pytest.raises(ValueError, match=r"is, or holds, the dataset that is read \(.*\); give"):
            data.convert(read, target, dest_format=format, mode="overwrite", progress=False)
    # A location that is relative to a former folder.
    monkeypatch.chdir(tmp_path)
    opened = data.load_dataset("held/a.npzs")
    monkeypatch.chdir(source.parent)
    with pytest.raises(ValueError, match=re.escape(f"the dataset that is read ({source})")):
        data.convert(opened, source, dest_format="npz", mode="overwrite", progress=False)
    assert data.load_dataset(source).lengths.tolist() == [5, 6]
    data.convert(source, tmp_path / "a.npzs", progress=False)
    assert data.load_dataset(tmp_path / "a.npzs").lengths.tolist() == [5, 6]


@pytest.mark.parametrize("mode", ["resume", "append", "overwrite", "error"])
def test_targets_of_user_defined_formats_may_be_no_paths(tmp_path, numpy_format, monkeypatch, mode):
    class Failing(Given):
        path = property(lambda self: Path("nothing").resolve(strict=True))

        def __init__(self):
            self.lengths, self.load_episode = [5], lambda index: {**episode(index, 5), "words": "go"}

    class Held(Suppressing):
        # Can be read once.
        def open_reader(self):
            if not self.lengths:
                raise LookupError("nothing is held")
            return Given(iter(self.lengths), None)

    monkeypatch.setattr(numpy_format, "open_writer", lambda target, mode: target)
    monkeypatch.setattr(numpy_format, "open_reader", Held.open_reader)
    target = Held(None)
    for count in (1, 2):
        # Two conversions to one target: only the mode "append" compares the new episodes.
        if count == 2 and mode != "append":
            break
        with pytest.warns(UserWarning, match="Held object.*: words are left out"):
            data.convert(Failing(), target, dest_format="npz", mode=mode, progress=False)
        assert target.lengths == [5] * count
    target.write_episode = lambda ep_data: None
    with pytest.raises(RuntimeError, match="Held object.*: its writer was given 1 episodes of 5 rows, and stored"):
        data.convert(Given([5], lambda index: episode(index, 5)), target, dest_format="npz", mode="append", progress=False)


def test_mode_error_is_not_left_to_the_writer_of_a_user(tmp_path, numpy_format, monkeypatch):
    path, source, open_writer = tmp_path / "a.npzs", tmp_path / "b.lance", numpy_format.open_writer
    write(path, (5, 6))
    write(source, (4,))
    monkeypatch.setattr(numpy_format, "open_writer", lambda path, mode: open_writer(path))
    buffer = data.ReplayBuffer(100)
    buffer.write_episode(episode(0, 7))
    (tmp_path / "gone.npzs").symlink_to(tmp_path / "nothing")
    for target in (path, tmp_path / "gone.npzs"):
        for write_to in (
            partial(data.merge, [source], progress=False),
            partial(data.convert, source, mode="error", progress=False),
            partial(buffer.dump, mode="error"),
            partial(data.open_writer, mode="error"),
        ):
            with pytest.raises(FileExistsError, match="there is a dataset already; add to it"):
                write_to(target)
    assert data.load_dataset(path).lengths.tolist() == [5, 6]
    buffer.dump(tmp_path / "c.npzs", mode="error")
    assert data.load_dataset(tmp_path / "c.npzs").lengths.tolist() == [7]


def test_a_refused_collection_opens_no_writer_of_a_user(tmp_path, numpy_format):
    path = tmp_path / "a.npzs"
    write(path, (5, 6))
    with swm.World("swm/TwoRoom-v1", 1) as world:
        world.set_policy(swm.policy.RandomPolicy())
        with pytest.raises(ValueError, match="codec: the writer decides"):
            world.collect(path, episodes=1, mode="overwrite", codec="lossless")
        with pytest.raises(ValueError, match="mode"):
            world.collect(path, episodes=1, mode="replace")
    assert data.load_dataset(path).lengths.tolist() == [5, 6]


def several(name, value):
    """Episodes of which the second has another column."""
    return lambda index: {**episode(index, 5), **({name: value} if index else {})}


@pytest.mark.parametrize(
    ("reader", "error", "message"),
    [
        (lambda: Given([4], lambda i: episode(i, 5)), ValueError, r"episode 0: .* 5 rows of 'pixels', but lengths\[0\] is 4"),
        (lambda: Given([5, 6], lambda i: episode(i, 5)), ValueError, r"episode 1: .* 5 rows of 'pixels', .* is 6"),
        (lambda: Given([5, 5], several("mass", np.ones(5))), ValueError, r"episode 1: .*missing \[\], unexpected \['mass'\]"),
        (lambda: Given([5, 5], several("state", "at rest")), ValueError, r"episode 1: .*missing \['state'\], unexpected \[\]"),
        (lambda: Given([5], lambda i: {"words": "go"}), ValueError, "episode 0: it has no columns"),
        (
            lambda: Given(iter([5]), lambda i: episode(i, 5)),
            TypeError,
            "lengths: .* got an iterator, which can be read only once",
        ),
        (lambda: Given("5", lambda i: episode(i, 5)), TypeError, "lengths: expected a list .* got '5'"),
        (lambda: Given(5, lambda i: episode(i, 5)), TypeError, "lengths: expected a list .* got 5"),
        (lambda: Given({0: 5}, lambda i: episode(i, 5)), TypeError, "lengths: expected a list .* got {0: 5}"),
        (lambda: Given([5, 5.5], lambda i: episode(i, 5)), ValueError, r"lengths\[1\]: expected a whole number .* got 5.5"),
        (lambda: Given([np.nan], lambda i: episode(i, 5)), ValueError, r"lengths\[0\]: expected a whole number .* got nan"),
        (lambda: Given(["5"], lambda i: episode(i, 5)), ValueError, r"lengths\[0\]: expected a whole number .* got '5'"),
        (lambda: Given([-1], lambda i: episode(i, 5)), ValueError, r"lengths\[0\]: expected a whole number .* got -1"),
    ],
)
def test_readers_that_contradict_themselves_are_refused(tmp_path, numpy_format, reader, error, message):
    for name in ("a.h5", "a.lance", "a.npzs"):
        with pytest.raises(error, match=message):
            data.convert(reader(), tmp_path / name, progress=False)


def test_whole_lengths_of_any_type_and_short_columns_of_actions_and_texts_are_read(tmp_path):
    class Fresh:
        lengths = property(lambda self: map(len, ("three", "words")))

        def load_episode(self, index):
            content = episode(index, 5)
            return {**content, "action": content["action"][:-1].tolist(), "words": "go", data.EPISODE_DATA_KEY: {"mass": 2.5}}

    for number, lengths in enumerate((None, np.array([5.0, 5.0]), (5, np.int32(5)))):
        reader = Fresh() if lengths is None else Given(lengths, Fresh().load_episode)
        with pytest.warns(UserWarning, match="episode_data, words are left out"):
            assert data.convert(reader, tmp_path / f"{number}.h5", progress=False)["rows"] == 10
    # A loader of columns that all episodes have.
    reader = Given([5, 5], several("mass", np.ones(5)))
    assert len(data.Loader(reader, 2, columns=["state"], backend="numpy", cache=0)) == 5
    # A loader of episodes with one observation more than actions, of which the lengths are those of the actions.
    longer = Given([4, 4], lambda index: {"state": np.arange(5.0), "action": np.ones((4, 1))})
    for batch in data.Loader(longer, 8, backend="numpy", cache=0, shuffle=False):
        assert batch["state"].ravel().tolist() == [0, 1, 2, 3] * 2


class Suppressing:
    """A writer of the user that suppresses errors, and returns nothing or something else when it is entered."""

    def __init__(self, entered):
        self.entered, self.lengths = entered, []

    def __enter__(self):
        return self.entered

    def __exit__(self, *exc):
        return True

    def write_episode(self, ep_data):
        self.lengths.append(len(ep_data["action"]))

    def write_episodes(self, episodes):
        for content in episodes:
            self.write_episode(content)


@pytest.mark.parametrize("entered", [None, "a file", Suppressing(None)])
def test_writers_of_the_user_are_entered_and_left_alike(tmp_path, numpy_format, monkeypatch, entered):
    def failing(index):
        if index:
            raise OSError("the source cannot be read")
        return episode(0, 5)

    writer = Suppressing(entered)
    monkeypatch.setattr(numpy_format, "open_writer", lambda path, mode: writer)
    buffer = data.ReplayBuffer(100)
    buffer.write_episode(episode(0, 6))
    with pytest.raises(OSError, match="the source cannot be read"):
        data.convert(Given([5, 5], failing), tmp_path / "a.npzs", verify=False, progress=False)
    buffer.dump(tmp_path / "a.npzs")
    with swm.World("swm/TwoRoom-v1", add_pixels=False, max_episode_steps=3) as world:
        counts = world.collect(tmp_path / "a.npzs", policy=swm.policy.RandomPolicy(1), episodes=1, seed=1, progress=False)
    assert counts == {"episodes": 1, "added": 1, "steps": 3}
    if isinstance(entered, Suppressing):
        assert writer.lengths == []
        writer = entered
    assert writer.lengths[-3:] == [5, 6, 4]


def test_writers_of_the_user_need_the_method_that_is_called(tmp_path, numpy_format, monkeypatch):
    several, one = SimpleNamespace(write_episodes=list), SimpleNamespace(write_episode=len)
    opened = several
    monkeypatch.setattr(numpy_format, "open_writer", lambda path, mode: nullcontext(opened))
    buffer = data.ReplayBuffer(100)
    buffer.write_episode(episode(0, 6))
    buffer.dump(tmp_path / "a.npzs")
    convert = partial(data.convert, Given([5], lambda index: episode(index, 5)), tmp_path / "a.npzs", progress=False)
    with pytest.raises(TypeError, match="writer: SimpleNamespace has no write_episode, which"):
        convert()
    opened = one
    assert convert(verify=False)["episodes"] == 1
    with pytest.raises(TypeError, match="writer: SimpleNamespace has no write_episodes, which"):
        buffer.dump(tmp_path / "a.npzs")


def test_format_names_are_unique_and_native_formats_are_registered(numpy_format):
    with pytest.raises(ValueError, match="registered already"):
        data.register_format(type("Lance", (data.Format,), {"name": "lance"}))
    with pytest.raises(ValueError, match="needs a `name`"):
        data.register_format(type("Nameless", (data.Format,), {}))
    assert data.register_format(numpy_format) is numpy_format, "the same class can be registered again"
    reads = type("Reads", (data.Format,), {"name": "reads"})
    with pytest.raises(NotImplementedError, match="'reads' cannot be written"):
        reads.open_writer("x")
    for name in ("lance", "hdf5", "video", "folder", "lerobot", "lance-video"):
        assert data.get_format(name).native
    assert isinstance(data.open_writer("never.lance"), data.Writer)


def test_conversion_between_native_formats_keeps_the_content(tmp_path):
    write(tmp_path / "a.lance")
    sums = set()
    for target, kwargs in (("b.h5", {}), ("c", {"format": "folder", "codec": "png"}), ("d.lance", {"codec": "png"})):
        report = data.convert(tmp_path / "a.lance", tmp_path / target, progress=False, **kwargs)
        assert report["episodes"] == 4 and report["kept"] == 0
        sums.add(report["checksum"])
        again = data.convert(tmp_path / "a.lance", tmp_path / target, progress=False, **kwargs)
        assert again["kept"] == 4 and again["rows"] == 0
    assert len(sums) == 1
    with pytest.raises(ValueError, match="without loss"):
        data.convert(tmp_path / "a.lance", tmp_path / "f.h5", progress=False, least_psnr=5)
    with pytest.raises(ValueError, match="not the beginning of the source"):
        write(tmp_path / "e.lance", (3,))
        data.convert(tmp_path / "a.lance", tmp_path / "e.lance", progress=False)
    data.convert(tmp_path / "a.lance", tmp_path / "e.lance", mode="append", progress=False)
    assert data.load_dataset(tmp_path / "e.lance").num_episodes == 5
    with pytest.raises(ValueError, match="the dataset that is read"):
        data.convert(tmp_path / "a.lance", tmp_path / "a.lance", mode="overwrite", progress=False)
    with pytest.raises(TypeError, match="takes no colour"):
        data.convert(tmp_path / "a.lance", tmp_path / "f.lance", colour="red", progress=False)


def test_doctor_keeps_intact_episodes_and_inspect_reports_sizes_and_columns(tmp_path):
    write(tmp_path / "a.lance")
    assert data.doctor(tmp_path / "a.lance", progress=False)["problems"] == 0
    broken = episodes((6, 6))
    broken[1]["state"][3] = np.inf
    with data.open_writer(tmp_path / "b.lance", manifest={"why": "a test"}) as writer:
        writer.write_episodes(broken)
    found = data.doctor(tmp_path / "b.lance", repair=tmp_path / "c.lance", progress=False)
    assert found["problems"] == 1 and found["sound"] == [0] and found["repaired"]["episodes"] == 1
    assert data.load_dataset(tmp_path / "c.lance").lengths.tolist() == [6]
    seen = data.inspect(tmp_path / "b.lance")
    assert (seen["episodes"], seen["steps"], seen["lengths"]) == (2, 12, [6, 6])
    assert seen["manifest"]["config"] == {"why": "a test"}
    assert {"name": "state", "dtype": "float64", "shape": [4]} in seen["columns"]
    json.dumps(seen)


CONVERTING = """
import sys
from stable_worldmodel import data, _engine
from stable_worldmodel.data import utils

def report(stage, done, total):
    if done == 2:
        print("converting", flush=True)
        sys.stdin.readline()

utils._progress_callback = lambda progress: report
try:
    data.convert(sys.argv[1], sys.argv[2])
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


def test_ctrl_c_keeps_converted_episodes(tmp_path):
    write(tmp_path / "a.lance")
    target = tmp_path / "b.lance"
    command = [sys.executable, "-c", CONVERTING, str(tmp_path / "a.lance"), str(target)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "converting\n"
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate("\n", timeout=60)
    assert output == "interrupted\n" and process.returncode == 0
    assert data.load_dataset(target).num_episodes == 2
    assert data.convert(tmp_path / "a.lance", target, progress=False)["kept"] == 2


def test_refused_first_episode_defines_no_columns(tmp_path):
    writer, buffer = data.open_writer(tmp_path / "a.lance"), data.ReplayBuffer(100)
    with pytest.raises(ValueError):
        writer.write_episode({"x": np.zeros((3, 0))})
    with pytest.raises(ValueError):
        buffer.write_episode({"y": np.zeros(500)})
    for target in (writer, buffer):
        target.write_episode({"x": np.arange(6.0)})
    writer.close()
    assert data.load_dataset(tmp_path / "a.lance").lengths.tolist() == [6]
    assert buffer.lengths.tolist() == [6] and buffer.column_names == ["x"]


def test_hdf5_file_whose_creation_was_killed_is_written_again(tmp_path):
    path = tmp_path / "a.h5"
    write(path, (5,))
    # The signature is written last.
    path.write_bytes(bytes(8) + path.read_bytes()[8:])
    write(path, (6,))
    assert data.load_dataset(path).lengths.tolist() == [6]


class Reused:
    """A reader that fills one buffer again and again, as a decoder may."""

    lengths = np.full(6, 8)

    def __init__(self):
        self.buffers = {name: np.zeros((8, 1), np.float32) for name in ("x", "y", "action")}

    def load_episode(self, index):
        for buffer in self.buffers.values():
            buffer[:] = index
            # Another thread may run.
            time.sleep(0.001)
        return self.buffers


@pytest.mark.parametrize("threads", [0, 1, 4])
def test_readers_may_reuse_their_buffers(threads):
    reader = Reused()
    loaders = [data.Loader(reader, batch_size=8, threads=threads, seed=seed, columns=["x", "y", "action"]) for seed in (0, 1)]
    for batches in zip(*loaders, strict=True):
        for batch in batches:
            assert np.array_equal(batch["x"], batch["y"]) and np.array_equal(batch["x"], batch["action"])
