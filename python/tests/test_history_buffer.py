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


def test_wrong_sizes_are_named():
    with pytest.raises(ValueError, match="HistoryBuffer: action_block: 0; expected a whole number of at least 1"):
        HistoryBuffer(1, 3, action_block=0)
    with pytest.raises(ValueError, match=r"'x' has shape \(3,\), expected \(2, \.\.\)"):
        HistoryBuffer(2, 3).append({"x": np.zeros(3)})
    assert swm.buffer.HistoryBuffer is HistoryBuffer
