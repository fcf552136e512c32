"""Small datasets with known content."""

import numpy as np

from stable_worldmodel import data

LENGTHS = (12, 20, 9, 30)


def episode(number, length, side=16):
    """An episode with pixels and values that depend on `number`."""
    random = np.random.default_rng(number)
    action = random.normal(size=(length, 2)).astype(np.float32)
    action[-1] = np.nan
    y, x = np.mgrid[0:side, 0:side]
    frames = [np.stack([8 * x + step, 8 * y + 16 * number, x + y + 3 * step], axis=-1) % 256 for step in range(length)]
    return {
        "pixels": np.stack(frames).astype(np.uint8),
        "action": action,
        "state": random.normal(size=(length, 4)),
        "reward": np.arange(length, dtype=np.float64) + 100 * number,
        "terminated": np.arange(length) == length - 1,
    }


def episodes(lengths=LENGTHS):
    return [episode(number, length) for number, length in enumerate(lengths)]


def write(path, lengths=LENGTHS, **kwargs):
    """Writes the episodes and returns them."""
    written = episodes(lengths)
    with data.open_writer(path, **kwargs) as writer:
        writer.write_episodes(written)
    return written


def clips(written, num_steps, frameskip):
    """The expected clips of episodes: pixels channels first, the actions of each step joined."""
    span = num_steps * frameskip
    found = []
    for content in written:
        for start in range(len(content["action"]) - span + 1):
            clip = {name: array[start : start + span : frameskip] for name, array in content.items()}
            clip["pixels"] = clip["pixels"].transpose(0, 3, 1, 2)
            clip["action"] = content["action"][start : start + span].reshape(num_steps, -1)
            found.append(clip)
    return found


def same(found, expected, lists=False):
    """Asserts that two samples are equal; with `lists`, that `found` has scalars as lists of one element."""
    assert set(found) == set(expected)
    for name, array in expected.items():
        array = array[:, None] if lists and array.ndim == 1 else array
        assert tuple(found[name].shape) == array.shape, name
        np.testing.assert_array_equal(np.asarray(found[name]), array, err_msg=name)
        assert np.asarray(found[name]).dtype == array.dtype, name
