"""Tests of `HistoryBuffer`: which steps it returns, and their shapes."""

import numpy as np
import pytest

import stable_worldmodel as swm
from stable_worldmodel.buffer import HistoryBuffer


def step(t, envs=2):
    return {
        "pixels": np.full((envs, 1, 4, 4, 3), t, np.uint8),
        "action": np.full((envs, 1, 2), t, np.float32),
        "reward": np.full(envs, t, np.float32),
        "names": ["a"] * envs,
    }


def filled(steps, **more):
    buffer = HistoryBuffer(n_envs=2, max_len=5, **more)
    for t in range(steps):
        buffer.append(step(t))
    return buffer


def test_steps_are_strided_and_actions_of_a_block_are_joined():
    found = filled(4, action_block=2, block_keys=("action",)).get(2)
    assert found["pixels"].shape == (2, 2, 4, 4, 3) and found["pixels"][0, :, 0, 0, 0].tolist() == [1, 3]
    assert found["action"].tolist() == [[[0, 0, 1, 1], [2, 2, 3, 3]]] * 2
    assert found["reward"].tolist() == [[1, 3]] * 2 and "names" not in found
    # Without `block_keys`, an action is strided as every other column.
    assert filled(4, action_block=2).get(2)["action"][0].tolist() == [[1, 1], [3, 3]]


@pytest.mark.parametrize(("steps", "frames", "blocks"), [(1, 1, 0), (2, 1, 1), (3, 2, 1), (4, 2, 2), (5, 3, 2), (9, 3, 2)])
def test_history_grows_during_the_first_steps(steps, frames, blocks):
    buffer = filled(steps, action_block=2, block_keys=("action",))
    found = buffer.get(3)
    assert found["pixels"].shape[1] == frames == buffer.num_strided() and found["action"].shape == (2, blocks, 4)
    assert len(buffer) == min(steps, 5)


def test_environments_are_reset_and_selected_separately():
    buffer = filled(3)
    buffer.reset(env_ids=[0])
    assert buffer.get(2) is None and buffer.num_strided() == 0 and len(buffer) == 0
    assert buffer.get(2, env_ids=[1])["reward"].tolist() == [[1, 2]]
    buffer.append(step(7))
    assert buffer.get(2)["reward"].tolist() == [[7], [7]]
    assert buffer.get(0) is None


def test_steps_are_copied_and_tensors_stay_tensors():
    torch = pytest.importorskip("torch")
    buffer, values = HistoryBuffer(1, 3), np.zeros((1, 1))
    buffer.append({"x": values, "y": torch.zeros(1, 2, 3)})
    values[:] = 5
    found = buffer.get(1)
    assert found["x"].tolist() == [[0.0]] and torch.is_tensor(found["y"]) and found["y"].shape == (1, 2, 3)


@pytest.mark.parametrize("blocks", [(), ("action",)])
def test_changed_columns_are_named(blocks):
    for change, form in (({"action": np.zeros((2, 1, 3))}, r"\(1, 2\), \(1, 3\)"), ({"new": np.zeros(2)}, r"\(\), missing")):
        buffer = filled(3, action_block=2, block_keys=blocks)
        buffer.append({**step(3), **change})
        with pytest.raises(ValueError, match=f"the steps differ in '{next(iter(change))}' \\({form}\\)"):
            buffer.get(2)


def test_environments_are_selected_by_a_mask():
    buffer = HistoryBuffer(n_envs=4, max_len=5)
    for t in range(3):
        buffer.append({"x": np.arange(4) * 10 + t})
    done = np.array([False, False, True, False])
    assert buffer.get(1, done)["x"].tolist() == buffer.get(1, [2])["x"].tolist() == [[22]]
    assert buffer.num_strided(~done) == 3 and buffer.get(1, [False] * 4) is None
    buffer.reset(done)
    assert [buffer.num_strided([env]) for env in range(4)] == [3, 3, 0, 3]
    torch = pytest.importorskip("torch")
    buffer.reset(torch.tensor([True, False, False, False]))
    buffer.reset(torch.tensor([1]))
    assert [buffer.num_strided([env]) for env in range(4)] == [0, 0, 0, 3]


@pytest.mark.parametrize(
    ("given", "error", "text"),
    [
        (np.array([True, False, False]), ValueError, r"expected a mask of 2 booleans, got the shape \(3,\)"),
        ([1.7], TypeError, r"expected indices or a mask of booleans, got \[1.7\]"),
        ("0", TypeError, "expected indices or a mask of booleans, got '0'"),
        ([5], ValueError, "5; expected indices from 0 to 1"),
        ([-1], ValueError, "-1; expected indices from 0 to 1"),
    ],
)
def test_environments_that_do_not_exist_are_refused(given, error, text):
    buffer = filled(3)
    for call in (lambda: buffer.get(1, given), lambda: buffer.reset(given), lambda: buffer.num_strided(given)):
        with pytest.raises(error, match=f"HistoryBuffer: env_ids: {text}"):
            call()
    assert len(buffer) == 3


@pytest.mark.parametrize("blocks", [(), ("action",)])
def test_columns_that_later_steps_lack_are_named(blocks):
    buffer = filled(1, action_block=2, block_keys=blocks)
    for _ in range(3):
        buffer.append({key: value for key, value in step(1).items() if key != "action"})
    assert "action" not in buffer.get(1) or not blocks
    if blocks:
        with pytest.raises(ValueError, match=r"the steps differ in 'action' \(\(1, 2\), missing\)"):
            buffer.get(2)
    buffer = filled(2)
    buffer.append({"reward": np.zeros(2)})
    with pytest.raises(ValueError, match=r"the steps differ in 'pixels' \(\(1, 4, 4, 3\), missing\)"):
        buffer.get(2)
    assert list(buffer.get(1)) == ["reward"], "the steps before are not read"


def test_wrong_sizes_are_named():
    with pytest.raises(ValueError, match="HistoryBuffer: action_block: 0; expected a whole number of at least 1"):
        HistoryBuffer(1, 3, action_block=0)
    with pytest.raises(ValueError, match=r"'x' has shape \(3,\), expected \(2, \.\.\)"):
        HistoryBuffer(2, 3).append({"x": np.zeros(3)})
    assert swm.buffer.HistoryBuffer is HistoryBuffer
