"""Measures plans and encodings of a LeWM of the published size in PyTorch.

    python -m stable_worldmodel.bench plan --device cuda

Weights and frames are random. A row is a way of computing: `eager` calls every kernel, `captured` replays CUDA graphs as
solvers do on an NVIDIA GPU, `compiled` also compiles with `torch.compile`. Products are in single precision, in TF32 or in
bf16 (autocast). The share is that of the rate at which the same device multiplies two matrices of 8192 x 8192 elements.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from .planning.solver import CEMSolver
from .policy import PlanConfig
from .wm.encoders import ViT
from .wm.lewm import LeWM
from .wm.lewm.module import MLP, Embedder, Predictor

__all__ = ["main"]

#: The model step of the published LeWM: five actions of two dimensions.
_ACTIONS = 10
#: Candidates, horizon, iterations and elites of the published plan.
_SAMPLES, _HORIZON, _ITERATIONS, _ELITES = 300, 5, 30, 30


def lewm() -> LeWM:
    """A LeWM of the published size with random weights."""
    dim, latent, hidden = 192, 192, 2048
    predictor = Predictor(
        num_frames=3, depth=6, heads=16, mlp_dim=hidden, input_dim=latent, hidden_dim=dim, dim_head=64, dropout=0.1
    )
    for layer in predictor.transformer.layers:
        nn.init.normal_(layer.adaLN_modulation[1].weight, std=0.02)  # type: ignore[union-attr, index]
    return LeWM(
        encoder=ViT(image=224, patch=14, dim=dim, depth=12, heads=3, mlp=4 * dim),
        predictor=predictor,
        action_encoder=Embedder(_ACTIONS, _ACTIONS, latent),
        projector=MLP(dim, hidden, latent, nn.BatchNorm1d),
        pred_proj=MLP(latent, hidden, latent, nn.BatchNorm1d),
    )


class Bench:
    """The measurements on a device.

    Args:
        device: A device of torch.
        repeats: Measurements of each row, of which the median is shown.
    """

    def __init__(self, device: str, repeats: int) -> None:
        self.device, self.repeats = torch.device(device), repeats
        self.rows: list[dict[str, Any]] = []
        self._peaks: dict[str, float] = {}

    def plan(self, way: str, precision: str, envs: int) -> None:
        """Time of a plan by the cross-entropy method: encoding frames and goals, then all iterations."""
        model = self._model(way)
        solver = CEMSolver(model, num_samples=_SAMPLES, n_steps=_ITERATIONS, topk=_ELITES, device=self.device, batch_size=envs)
        space = gym.spaces.Box(-1.0, 1.0, shape=(envs, _ACTIONS), dtype=np.float32)
        solver.configure(action_space=space, n_envs=envs, config=PlanConfig(horizon=_HORIZON, receding_horizon=_HORIZON))
        frames = torch.randint(0, 256, (2, envs, 1, 3, 224, 224), dtype=torch.uint8)
        infos = {"pixels": frames[0], "goal": frames[1]}
        solve = self._in(precision, lambda: solver.solve(infos))
        plain = self._model("eager")
        flops = self._flops(lambda: plain.get_cost(*self._candidates(frames, envs))) * _ITERATIONS
        self._row("plan", way, precision, envs, flops, self._seconds(solve), 1e3, "ms each", per=envs)

    def encode(self, way: str, precision: str, frames: int) -> None:
        """Frames encoded in a second, frames of bytes at once."""
        model = self._model(way)
        pixels = torch.randint(0, 256, (1, frames, 3, 224, 224), dtype=torch.uint8, device=self.device)
        encode = self._in(precision, lambda: model.encode({"pixels": pixels}))
        plain = self._model("eager")
        flops = self._flops(lambda: plain.encode({"pixels": pixels}))
        self._row("encode", way, precision, frames, flops, self._seconds(encode), 1.0, "frames/s", per=frames)

    def _model(self, way: str) -> LeWM:
        torch.manual_seed(0)
        model = lewm().to(self.device).eval()
        if way == "eager":
            model.prepare_plan = None  # type: ignore[assignment]
        if way == "compiled":
            compiled: Any = model
            compiled.compile(dynamic=False)
        return model

    def _candidates(self, frames: torch.Tensor, envs: int) -> tuple[dict[str, Any], torch.Tensor]:
        """The infos and candidates of an iteration, frames and goals already encoded."""

        def expand(x: torch.Tensor) -> torch.Tensor:
            return x.to(self.device)[:, None].expand(-1, _SAMPLES, *x.shape[1:])

        latent = torch.zeros(envs, 1, 192, device=self.device)
        infos = {"pixels": expand(frames[0]), "goal": expand(frames[1]), "emb": expand(latent), "goal_emb": latent}
        return infos, torch.zeros(envs, _SAMPLES, _HORIZON, _ACTIONS, device=self.device)

    def _in(self, precision: str, work: Callable[[], Any]) -> Callable[[], Any]:
        """The work in a precision, without gradients."""

        def run() -> None:
            half: AbstractContextManager[Any] = (
                torch.autocast(self.device.type, torch.bfloat16) if precision == "bf16" else nullcontext()
            )
            torch.set_float32_matmul_precision("high" if precision == "tf32" else "highest")
            with torch.inference_mode(), half:
                work()
            self._wait()

        return run

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize()

    def _flops(self, work: Callable[[], Any]) -> float:
        """The floating-point operations of a work that is not compiled: `torch.compile` gives up while they are counted."""
        with torch.no_grad(), FlopCounterMode(display=False) as counter:
            work()
        return float(counter.get_total_flops())

    def _seconds(self, work: Callable[[], Any]) -> list[float]:
        # The first runs compile and record.
        for _ in range(2):
            work()
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats()
        found = []
        for _ in range(self.repeats):
            begin = time.perf_counter()
            work()
            found.append(time.perf_counter() - begin)
        return found

    def _peak(self, precision: str) -> float:
        """The rate of a large product, in floating-point operations a second."""
        if precision not in self._peaks:
            size = 8192 if self.device.type == "cuda" else 1024
            a = torch.randn(size, size, device=self.device)
            times = self._seconds(self._in(precision, lambda: [a @ a for _ in range(5)]))
            self._peaks[precision] = 5 * 2 * size**3 / min(times)
        return self._peaks[precision]

    def _row(
        self,
        work: str,
        way: str,
        precision: str,
        size: int,
        flops: float,
        times: list[float],
        scale: float,
        unit: str,
        per: int,
    ) -> None:
        seconds = statistics.median(times)
        value = scale * seconds / per if scale > 1 else per / seconds
        memory = torch.cuda.max_memory_allocated() / 2**30 if self.device.type == "cuda" else None
        share = flops / seconds / self._peak(precision)
        row = {
            "work": work,
            "way": way,
            "precision": precision,
            "size": size,
            "value": value,
            "unit": unit,
            "seconds": times,
            "flops": flops,
            "share": share,
            "memory_gib": memory,
        }
        self.rows.append(row)
        gib = "" if memory is None else f", {memory:.1f} GiB"
        print(
            f"{work:>6} {size:>4} {way:>8} {precision:>6} {value:>10.1f} {unit}, {flops / seconds / 1e12:.1f} TFLOP/s "
            f"({100 * share:.0f} % of a large product){gib}",
            file=sys.stderr,
            flush=True,
        )


def main(arguments: list[str] | None = None) -> None:
    """Parses the command line, measures, and prints the rows as JSON if asked to."""
    parser = argparse.ArgumentParser("python -m stable_worldmodel.bench", description=__doc__.splitlines()[0])
    parser.add_argument("work", choices=["plan", "encode"])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", help="a device of torch")
    parser.add_argument("--sizes", default="", help="environments of a plan, or frames at once; such as 1,64")
    parser.add_argument("--ways", default="eager,captured,compiled", help="of eager, captured and compiled")
    parser.add_argument("--precisions", default="single,tf32,bf16", help="of single, tf32 and bf16")
    parser.add_argument("--repeats", type=int, default=5, help="measurements of each row; the median is shown")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON on standard output")
    given = parser.parse_args(arguments)
    ways = _words(parser, "--ways", given.ways, ("eager", "captured", "compiled"))
    precisions = _words(parser, "--precisions", given.precisions, ("single", "tf32", "bf16"))
    default = "1,64" if given.work == "plan" else "1,256"
    sizes = _words(parser, "--sizes", given.sizes or default, None)
    if given.repeats < 1:
        parser.error(f"--repeats {given.repeats}: expected at least 1")
    try:
        torch.empty(1, device=given.device).cpu()
    except (RuntimeError, NotImplementedError, AssertionError) as error:
        parser.error(
            f"--device {given.device}: {str(error).splitlines()[0]}; expected a device of torch, such as cpu or cuda:0"
        )
    bench = Bench(given.device, given.repeats)
    for size in map(int, sizes):
        for precision in precisions:
            for way in ways:
                if way == "captured" and given.work == "encode":
                    continue
                getattr(bench, given.work)(way, precision, size)
    if given.json:
        print(json.dumps(bench.rows))


def _words(parser: argparse.ArgumentParser, option: str, text: str, known: tuple[str, ...] | None) -> list[str]:
    words = text.split(",")
    for word in words:
        if known is None and not (word.isdecimal() and 0 < int(word) <= 4096):
            parser.error(f"{option}: {word!r}; expected numbers from 1 to 4096, separated by commas")
        if known is not None and word not in known:
            parser.error(f"{option}: {word!r}; expected words of {', '.join(known)}, separated by commas")
    return words


if __name__ == "__main__":
    main()
