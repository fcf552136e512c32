"""Clips per second of a torch training loop: our loader, our dataset in torch's DataLoader, and the reference's dataset.

    python benches/bench_loader.py --reference /path/to/python

The loop is LeRobot's: shuffled batches of 64 clips of 4 frames, 5 rows apart, at 224 pixels, each of which goes through a
training step of a trivial model, the same on all sides. Our loader runs twice: without a cache, and with its default cache
of decoded frames. All datasets have the content of one collection; the reference's are written by its own writers. The
reference runs in the Python that `--reference` (or `$SWM_REFERENCE_PYTHON`) names, in turns with ours; the result is the
median of the ratios of neighbouring turns. The reference runs with every number of workers, and ours is compared with the
fastest.
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

#: Name, our file, the writer's settings, the format of the reference's file.
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
    """The reference's side: answers `write FORMAT SOURCE PATH` and `turn FORMAT PATH WORKERS SECONDS`, a JSON line each."""
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
        raise SystemExit("the reference ended; run it by hand: REFERENCE benches/bench_loader.py --serve")

    def ask(self, *words: Any) -> Any:
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
    parser.add_argument("--seconds", type=float, default=2.0, help="of a turn")
    parser.add_argument("--workers", type=int, nargs="*", default=[0, 2], help="worker processes of DataLoaders")
    parser.add_argument("--threads", type=int, default=2, help="threads of our loader that load ahead")
    parser.add_argument("--cache", default="512MiB", help="size of our loader's cache of decoded frames, in one row")
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
        print(f"{'content':<17}{'how':<40}{'clips/s':>9}  {'x reference':>12}")
        for layout, place, writing, beside in LAYOUTS:
            data.convert(source, folder / place, progress=False, verify=False, **writing)
            ways: dict[str, Callable[[], float]] = {}
            for workers in given.workers if reference is not None else ():
                theirs = folder / f"theirs-{beside}.{'lance' if beside == 'lance' else 'h5'}"
                if not theirs.exists():
                    reference.ask("write", beside, folder / "episodes", theirs)
                ways[f"reference, {workers} workers"] = lambda theirs=theirs, workers=workers, beside=beside: reference.ask(
                    "turn", beside, theirs, workers, given.seconds
                )
            settings = {"columns": COLUMNS, "drop_last": True, "threads": given.threads, **CLIP}
            for how, cache in (("Loader, every frame decoded", 0), (f"Loader, {given.cache} of frames cached", given.cache)):
                batches = endless(data.Loader(folder / place, BATCH, cache=cache, **settings))
                ways[how] = lambda batches=batches: turn(batches, step, given.seconds)
            for workers in given.workers:
                dataset = data.load_dataset(folder / place, keys_to_load=COLUMNS, **CLIP)
                mine = endless(torch_loader(dataset, workers))
                ways[f"load_dataset, DataLoader, {workers} workers"] = lambda mine=mine: turn(mine, step, given.seconds)
            for way in ways.values():
                way()
            rates: dict[str, list[float]] = {how: [] for how in ways}
            for _ in range(given.pairs):
                for how, way in ways.items():
                    rates[how].append(way())
            rivals = [how for how in ways if how.startswith("reference")]
            fastest = max(rivals, key=lambda how: statistics.median(rates[how]), default=None)
            for how, mine in rates.items():
                line = f"{layout:<17}{how:<40}{statistics.median(mine):>9.0f}"
                if fastest is not None and how not in rivals:
                    ratio = statistics.median(a / b for a, b in zip(mine, rates[fastest], strict=True))
                    line += f"  {ratio:>11.1f}x"
                print(line, flush=True)


if __name__ == "__main__":
    main()
