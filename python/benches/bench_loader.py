"""Clips per second of a torch training loop: our loader, our dataset in torch's DataLoader, and the reference's dataset.

    python benches/bench_loader.py --reference /path/to/python

The loop loads shuffled batches of 64 clips of 4 frames, 5 rows apart, at 224 pixels. Each batch goes through a training
step of a trivial model, the same on all sides. Our loader runs twice: without a cache, and
with its default cache of decoded frames. All datasets have the content of one collection; the reference reads datasets
that its own writers wrote. The reference runs in the Python that `--reference` (or `$SWM_REFERENCE_PYTHON`) names, in turns
with our loader; the result is the median of the ratios of neighbouring turns. The reference runs with every number of
workers, and its fastest run is compared with our loader.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

COLUMNS = ["pixels", "action"]
CLIP = {"num_steps": 4, "frameskip": 5}
BATCH = 64

#: The name of the layout, our file, the settings of our writer, and the format of the reference's file.
LAYOUTS = [
    ("lance, jpeg", "jpeg.lance", {"codec": "jpeg"}, "lance"),
    ("lance, lossless", "lossless.lance", {}, "lance"),
    ("hdf5", "ours.h5", {}, "hdf5"),
]


def trainer() -> Callable[[dict[str, Any]], int]:
    """Creates a training step of negligible cost that returns the number of clips of its batch."""
    import torch

    model = torch.nn.Linear(CLIP["frameskip"] * 2 + 3, 1)
    optimizer = torch.optim.SGD(model.parameters(), 1e-6)

    def step(batch: dict[str, Any]) -> int:
        # Like the first layer of a model, this reads every frame, here only a few of its pixels.
        features = batch["pixels"][..., ::56, ::56].float().mean(dim=(-1, -2)) / 255
        loss = model(torch.cat([features, batch["action"].nan_to_num().float()], dim=-1)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return len(features)

    return step


def turn(batches: Iterator[dict[str, Any]], step: Callable[[dict[str, Any]], int], seconds: float) -> float:
    """Trains for about `seconds` and returns the clips per second."""
    begun, clips = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - begun) < seconds:
        clips += step(next(batches))
    return clips / elapsed


def endless(batches: Any) -> Iterator[dict[str, Any]]:
    while True:
        yield from batches


def torch_loader(dataset: Any, workers: int) -> Any:
    import torch

    context = "spawn" if workers else None
    kwargs = {"num_workers": workers, "multiprocessing_context": context, "persistent_workers": workers > 0}
    return torch.utils.data.DataLoader(dataset, BATCH, shuffle=True, drop_last=True, **kwargs)


def serve() -> None:
    """Runs in the reference's Python: answers `write FORMAT SOURCE PATH` and `turn FORMAT PATH WORKERS SECONDS` in JSON."""
    import numpy as np
    import torch

    from stable_worldmodel.data.format import get_format

    torch.set_num_threads(1)
    step = trainer()
    running: dict[tuple[str, str, str], Iterator[dict[str, Any]]] = {}

    def write(name: str, source: str, path: str) -> None:
        def episodes() -> Iterator[dict[str, Any]]:
            for file in sorted(Path(source).glob("*.npz")):
                yield {column: list(array) for column, array in np.load(file).items()}

        with get_format(name).open_writer(path, mode="overwrite") as writer:
            writer.write_episodes(episodes())

    def one_turn(name: str, path: str, workers: str, seconds: str) -> float:
        key = (name, path, workers)
        if key not in running:
            dataset = get_format(name).open_reader(path, keys_to_load=COLUMNS, **CLIP)
            running[key] = endless(torch_loader(dataset, int(workers)))
            next(running[key])
        return turn(running[key], step, float(seconds))

    print("SWM ready", flush=True)
    for line in sys.stdin:
        command, *words = line.rstrip("\n").split("\t")
        answer = (write if command == "write" else one_turn)(*words)
        print("SWM", json.dumps(answer), flush=True)


class Reference:
    """The reference implementation in a separate process."""

    def __init__(self, python: str) -> None:
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        command = [python, __file__, "--serve"]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
        )
        self.answer()

    def answer(self) -> Any:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("SWM "):
                return None if line == "SWM ready\n" else json.loads(line[4:])
        raise SystemExit("the reference ended; to see its error, run: REFERENCE_PYTHON benches/bench_loader.py --serve")

    def request(self, *words: Any) -> Any:
        assert self.process.stdin is not None
        print(*words, sep="\t", file=self.process.stdin, flush=True)
        return self.answer()


def collect(folder: Path, episodes: int, steps: int, size: int) -> Path:
    """Collects the content of all datasets: Push-T episodes of the random policy."""
    import numpy as np

    import stable_worldmodel as swm

    world = swm.World("swm/PushT-v1", num_envs=8, image_shape=(size, size), max_episode_steps=steps)
    world.set_policy(swm.policy.RandomPolicy(seed=0))
    world.collect(str(folder / "source.lance"), episodes=episodes, seed=0)
    (folder / "episodes").mkdir()
    source = swm.data.load_dataset(folder / "source.lance", keys_to_load=COLUMNS, backend="numpy")
    for episode in range(source.num_episodes):
        content = source.load_episode(episode)
        pixels = np.ascontiguousarray(content["pixels"].transpose(0, 2, 3, 1))
        np.savez(folder / "episodes" / f"{episode:05}.npz", pixels=pixels, action=content["action"])
    return folder / "source.lance"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", default=os.environ.get("SWM_REFERENCE_PYTHON"))
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--size", type=int, default=224)
    parser.add_argument("--pairs", type=int, default=5, help="turns of each side")
    parser.add_argument("--seconds", type=float, default=2.0, help="seconds of a turn")
    parser.add_argument("--workers", type=int, nargs="*", default=[0, 2], help="worker processes of DataLoaders")
    parser.add_argument("--threads", type=int, default=2, help="prefetch threads of our loader")
    parser.add_argument("--cache", default="512MiB", help="size of the cache of decoded frames, in our loader's cached runs")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve()
        return

    import torch

    from stable_worldmodel import data

    torch.set_num_threads(1)
    reference = Reference(given.reference) if given.reference else None
    step = trainer()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = collect(folder, given.episodes, given.steps, given.size)
        print(f"{given.episodes} episodes of {given.steps} steps at {given.size} px; load average {os.getloadavg()[0]:.1f}")
        print(f"{'layout':<17}{'loader':<40}{'clips/s':>9}  {'x reference':>12}")
        for layout, file, codec, reference_format in LAYOUTS:
            data.convert(source, folder / file, progress=False, verify=False, **codec)
            turns: dict[str, Callable[[], float]] = {}
            for workers in given.workers if reference is not None else ():
                stored = folder / f"reference.{'lance' if reference_format == 'lance' else 'h5'}"
                if not stored.exists():
                    reference.request("write", reference_format, folder / "episodes", stored)
                request = ("turn", reference_format, stored, workers, given.seconds)
                turns[f"reference, {workers} workers"] = lambda request=request: reference.request(*request)
            settings = {"columns": COLUMNS, "drop_last": True, "threads": given.threads, **CLIP}
            for label, cache in (("Loader, every frame decoded", 0), (f"Loader, {given.cache} of frames cached", given.cache)):
                batches = endless(data.Loader(folder / file, BATCH, cache=cache, **settings))
                turns[label] = lambda batches=batches: turn(batches, step, given.seconds)
            for workers in given.workers:
                dataset = data.load_dataset(folder / file, keys_to_load=COLUMNS, **CLIP)
                batches = endless(torch_loader(dataset, workers))
                label = f"load_dataset, DataLoader, {workers} workers"
                turns[label] = lambda batches=batches: turn(batches, step, given.seconds)
            # The first turn of each side warms the caches and is not counted.
            for run_turn in turns.values():
                run_turn()
            rates: dict[str, list[float]] = {label: [] for label in turns}
            for _ in range(given.pairs):
                for label, run_turn in turns.items():
                    rates[label].append(run_turn())
            references = [label for label in turns if label.startswith("reference")]
            fastest = max(references, key=lambda label: statistics.median(rates[label]), default=None)
            for label, measured in rates.items():
                line = f"{layout:<17}{label:<40}{statistics.median(measured):>9.0f}"
                if fastest is not None and label not in references:
                    ratio = statistics.median(a / b for a, b in zip(measured, rates[fastest], strict=True))
                    line += f"  {ratio:>11.1f}x"
                print(line, flush=True)


if __name__ == "__main__":
    main()
