"""Tests of datasets in torch's DataLoader: without workers, and with spawned and forked workers."""

import pickle
from multiprocessing.reduction import ForkingPickler

import numpy as np
import pytest
from data_helpers import LENGTHS, clips, episode, same, write

from stable_worldmodel import data

torch = pytest.importorskip("torch")
# Forked workers pickle their batches in a thread, in which imports of Python before 3.12 may fail: torch's are made here.
ForkingPickler.dumps(torch.zeros(1))


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "a.lance"
    return path, write(path)


@pytest.mark.parametrize(("workers", "context"), [(0, None), (2, "fork"), (2, "spawn")])
def test_data_loader_yields_every_clip(stored, workers, context):
    path, written = stored
    dataset = data.load_dataset(path, num_steps=3, frameskip=2)
    # Reading starts engine threads here, which a forked worker does not have.
    dataset.get_col_data("pixels")
    loader = torch.utils.data.DataLoader(dataset, 8, num_workers=workers, multiprocessing_context=context)
    expected = clips(written, 3, 2)
    found = 0
    for batch in loader:
        assert batch["pixels"].shape[1:] == (3, 3, 16, 16) and batch["pixels"].dtype == torch.uint8
        for i in range(len(batch["action"])):
            same({name: column[i] for name, column in batch.items()}, expected[found], True)
            found += 1
    assert found == len(expected)


def test_batches_are_collated_without_a_copy(stored):
    path, _ = stored
    dataset = data.load_dataset(path, num_steps=3)
    samples = dataset.__getitems__([5, 1, 30])
    batch = torch.utils.data.default_collate(samples)
    assert batch["pixels"][1].data_ptr() == samples[1]["pixels"].data_ptr()
    # A changed sample is collated with its change.
    samples[2]["reward"] = torch.full((3, 1), 7.0, dtype=torch.float64)
    changed = torch.utils.data.default_collate(samples)
    assert changed["reward"][2].eq(7).all() and changed["reward"][:2].equal(batch["reward"][:2])
    assert torch.utils.data.default_collate(samples[:2])["pixels"].equal(batch["pixels"][:2])
    assert set(torch.utils.data.default_collate([{**samples[0], "new": 1}])) == {*batch, "new"}


def test_tensors_share_the_memory_of_the_loader(stored):
    path, written = stored
    loader = data.Loader(path, 4, num_steps=2, shuffle=False, columns=["pixels", "action"])
    batches = [batch["pixels"] for batch in loader]
    del loader
    expected = np.stack([clip["pixels"] for clip in clips(written, 2, 1)])
    assert torch.cat(batches).numpy().tolist() == expected.tolist()
    model = torch.nn.Conv2d(3, 2, 3)
    assert model(batches[0].flatten(0, 1).float()).shape == (8, 2, 14, 14)


def test_scalers_take_tensors():
    scaler = data.ZScoreScaler(mean=[1.0, 2.0], std=[2.0, 0.0])
    scaled = scaler(torch.tensor([[3.0, 2.0]], dtype=torch.float64))
    assert scaled.dtype == torch.float32 and scaled.tolist() == [[1.0, 0.0]]
    assert data.PercentileScaler(q_low=[0.0], q_high=[4.0])(torch.tensor([[9.0], [1.0]])).tolist() == [[1.0], [-0.5]]


def test_scalers_of_many_rows_and_half_precision():
    column = np.random.default_rng(0).normal(300, 1, (2_000_000, 1)).astype(np.float32)
    scaler = data.ZScoreScaler().fit(column)
    assert scaler.mean.dtype == np.float32 and abs(scaler.mean.item() - 300) < 0.01 and abs(scaler.std.item() - 1) < 0.01
    halves = np.full((5, 1), 300, np.float16)
    scaled = data.ZScoreScaler().fit(halves).transform(torch.as_tensor(halves))
    assert scaled.dtype == torch.float16 and not scaled.any()
    halves = np.array([[300.0], [-300.0]], np.float16)
    assert data.ZScoreScaler().fit(halves).std.item() == 300
    with pytest.raises(ValueError, match="1 of 2 rows have an infinite number"):
        data.ZScoreScaler().fit(np.array([[1.0], [np.inf]]))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int32, torch.int64, torch.bool])
@pytest.mark.parametrize("method", ["zscore", "percentile"])
def test_scalers_take_tensors_of_integers(method, dtype):
    values = torch.tensor([[0], [1], [1], [0], [1]], dtype=dtype)
    scaler = data.get_scaler(method).fit(values)
    expected = data.get_scaler(method).fit_transform(values.double().numpy())
    np.testing.assert_allclose(scaler(values).numpy(), expected, rtol=1e-6)
    np.testing.assert_allclose(scaler.inverse_transform(scaler.transform(values)).numpy(), values.double(), atol=1e-6)


def test_episodes_of_tensors_are_written(tmp_path):
    with data.open_writer(tmp_path / "a.lance") as writer:
        writer.write_episode(
            {
                "pixels": torch.arange(4 * 3 * 6 * 5, dtype=torch.uint8).reshape(4, 3, 6, 5),
                "action": [torch.tensor([0.5]), torch.tensor([1.0]), torch.tensor([2.0])],
                "latent": torch.ones(4, 2, dtype=torch.bfloat16, requires_grad=True),
            }
        )
    sample = data.load_dataset(tmp_path / "a.lance", num_steps=4)[0]
    assert sample["pixels"].flatten()[:5].tolist() == [0, 1, 2, 3, 4]
    assert sample["action"][:3].tolist() == [[0.5], [1.0], [2.0]] and sample["action"][3].isnan().all()
    assert sample["latent"].dtype == torch.float32


@pytest.mark.parametrize("format", ["lance", "h5", "folder", "video", "lerobot"])
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_workers_that_start_after_the_dataset_was_replaced_refuse_it(tmp_path, format, context):
    path = tmp_path / f"d.{format}"
    write(path)
    dataset = data.load_dataset(str(path), num_steps=4)
    loader = torch.utils.data.DataLoader(dataset, batch_size=8, num_workers=1, multiprocessing_context=context)
    assert len(list(loader)) > 0
    with data.open_writer(path) as writer:
        writer.write_episode(episode(7, 15))
    before = sum(len(batch["reward"]) for batch in loader)
    assert before == len(dataset)
    with data.open_writer(path, mode="overwrite") as writer:
        writer.write_episodes([episode(number + 10, length) for number, length in enumerate(LENGTHS)])
    with pytest.raises(Exception, match="replaced since the dataset was opened"):
        list(loader)
    with pytest.raises(Exception, match="replaced since the dataset was opened"):
        pickle.loads(pickle.dumps(dataset))[0]
