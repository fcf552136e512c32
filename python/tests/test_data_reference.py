"""The reference implementation, if installed, reads the same samples from our datasets."""

import os
import subprocess

import numpy as np
import pytest
from data_helpers import write

from stable_worldmodel import data

REFERENCE = os.environ.get("SWM_REFERENCE_PYTHON", "")

READ = """
import pickle, sys
import numpy as np
from stable_worldmodel.data import load_dataset

dataset = load_dataset(sys.argv[1], num_steps=3, frameskip=2)
plain = lambda sample: {name: np.asarray(value) for name, value in sample.items()}
found = {
    "length": len(dataset),
    "columns": sorted(dataset.column_names),
    "clips": [plain(sample) for sample in (dataset[0], dataset[13], dataset[len(dataset) - 1])],
    "chunk": plain(dataset.load_chunk(np.array([1]), np.array([2]), np.array([8]))[0]),
    "episode": plain(dataset.load_episode(2)),
    "state": dataset.get_col_data("state"),
}
with open(sys.argv[2], "wb") as file:
    pickle.dump(found, file)
"""


@pytest.mark.skipif(not REFERENCE, reason="SWM_REFERENCE_PYTHON names no Python with the reference")
@pytest.mark.parametrize("name", ["a.lance", "a.h5"])
def test_reference_reads_the_same_samples(tmp_path, name):
    path, answer = tmp_path / name, tmp_path / "answer"
    write(path, codec="png" if name == "a.lance" else None)
    # `PYTHONPATH` may name this package instead of the reference.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    subprocess.run([REFERENCE, "-c", READ, path, answer], check=True, env=environment, cwd=tmp_path, capture_output=True)
    theirs = np.load(answer, allow_pickle=True)
    ours = data.load_dataset(path, num_steps=3, frameskip=2, backend="numpy")
    assert theirs["length"] == len(ours) and theirs["columns"] == sorted(ours.column_names)
    chunk = ours.load_chunk([1], [2], [8])[0]
    pairs = [*zip(theirs["clips"], (ours[0], ours[13], ours[-1]), strict=True)]
    for found, expected in [*pairs, (theirs["chunk"], chunk), (theirs["episode"], ours.load_episode(2))]:
        assert set(found) == set(expected)
        for column, array in expected.items():
            assert found[column].shape == array.shape, column
            # The reference returns some columns in single precision.
            np.testing.assert_allclose(found[column], array, rtol=1e-6, err_msg=column)
    np.testing.assert_allclose(theirs["state"], ours.get_col_data("state"), rtol=1e-6)
