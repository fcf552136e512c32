"""`Trainer`: the training loop in torch, whose checkpoints are those of `swm train`."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from .. import _engine
from ..data.foreign import engine_of
from ..data.loader import Goals, Loader
from ..data.utils import load_dataset
from ..wm._weights import read_safetensors
from ..wm.checkpoints import check_kind, module_of
from ..wm.pretrained import Pretrained, stored_names, write
from .losses import Losses, losses_of
from .optim import Optimizer, learning_rate
from .options import Options
from .ranks import Ranks

__all__ = ["Trainer"]


class Trainer:
    """A training in this process, which may be one of several.

    Args:
        options: The training.
        kind: A class derived from that of the family, whose methods replace the family's; the family's class for `None`.

    Raises:
        FileNotFoundError: If the dataset does not exist.
        TypeError: If the class is not derived from that of the family, or overrides a method that training does not call.
        ValueError: If a setting is invalid, or the folder of the checkpoint holds a run that cannot be continued.
    """

    def __init__(self, options: Options, kind: type[Pretrained] | None = None) -> None:
        self.options, self.run = options, options.run
        if torch.get_default_dtype() != torch.float32:
            problem = f"torch's default type is {torch.get_default_dtype()}, in which new modules would be made"
            raise ValueError(f"{problem}: call torch.set_default_dtype(torch.float32) before the training")
        losses = losses_of(options.family)
        check_kind(options.family, kind)
        self.device = _device(options.device)
        _check_compile(options.compile, self.device)
        self.ranks = Ranks.join(self.device)
        losses.check_kind(kind, self.ranks)
        if self.device.type == "cuda" and self.device.index is None and self.ranks.size > 1:
            self.device = torch.device("cuda", self.ranks.rank % torch.cuda.device_count())
        dataset = load_dataset(options.data)
        plan = self.ranks.first(lambda: self._begin(dataset))
        self.model: Any = module_of(self.run, kind)
        #: The moving average of the weights, by the names of the checkpoint; `None` without one.
        self.average: dict[str, Tensor] | None = None
        self.config: dict[str, Any] = self.model.stored.config
        state = self._restored()
        self.model.to(self.device)
        self.losses: Losses = losses(self.model, self.ranks, self._precision, self._compiled)
        self.optimizer = Optimizer(self.model, plan["parameters"], self.config["optim"])
        self.scaler = torch.amp.GradScaler(self.device.type, enabled=options.amp == "fp16")
        self.optimizer.restore(state["step"], read_safetensors(self.run / "checkpoint/optimizer.safetensors"), self.scaler)
        self.step: int = state["step"]
        self.window = Window.of(state.get("window"), self.losses.names)
        #: Whether the folder was found as this training read it, and `run.json` has the command.
        self.recorded = False
        self.best: Any = state["best"]
        self.validations_since_best: int = state["looks"]
        self.loader = self._loader(dataset, plan["training"])
        self.validation = None if plan["validation"] is None else self._loader(dataset, plan["validation"])
        self.waited = 0.0

    def _begin(self, dataset: Any) -> Any:
        """Writes the command and the first checkpoint of the training, or checks the checkpoint that it continues."""
        options = self.options
        # A kill while a checkpoint is replaced leaves the old one, which the engine gives its name back.
        self.resumed = options.resume and any((self.run / name).is_dir() for name in _engine.CHECKPOINT_FOLDERS)
        settings = list(options.settings)
        family, preset, command = options.family, options.preset, options.command()
        dataset, out = engine_of(dataset), str(self.run)
        return json.loads(_engine.begin_training(family, preset, settings, dataset, out, self.resumed, command))

    def _record(self) -> None:
        """Adds the command of a training that continues to `run.json`, under the lock of the folder, so that it has commands
        of trainings that ran.

        Raises:
            ValueError: If another process has trained in the folder since this training read the checkpoint.
        """
        if self.recorded or self.ranks.rank != 0:
            return
        stored = json.loads((self.run / "checkpoint/state.json").read_text(encoding="utf-8"))["step"]
        if stored != self.step:
            raise ValueError(
                f"{self.run}: another process has trained here, from step {self.step} to step {stored}; "
                "continue with resume=true, or choose another folder"
            )
        if self.resumed:
            _engine.record_training(str(self.run), self.options.command())
        self.recorded = True

    def _restored(self) -> Any:
        """The state of the run; the trained weights, if the checkpoint holds their average, replace the average."""
        folder = self.run / "checkpoint"
        if self.config["optim"].get("ema", 0.0) > 0:
            self.average = {name: value.to(self.device, copy=True) for name, value in self.model.checkpoint_weights().items()}
            raw = read_safetensors(folder / "raw.safetensors")
            own = {self.model._checkpoint_name(name): name for name in stored_names(self.model)}
            self.model.load_state_dict({own[name]: value for name, value in raw.items()}, strict=False)
        return json.loads((folder / "state.json").read_text(encoding="utf-8"))

    def _loader(self, dataset: Any, settings: Mapping[str, Any]) -> Loader:
        goals = [
            Goals(columns=goal["columns"], anchor=goal["anchor"], name=goal["name"], **goal["mixture"])
            for goal in settings["goals"]
        ]
        return Loader(
            dataset,
            settings["batch_size"],
            num_steps=settings["num_steps"],
            frameskip=settings["frameskip"],
            columns=settings["columns"],
            seed=settings["seed"],
            episodes=settings["episodes"],
            drop_last=settings["drop_last"],
            goals=goals,
            backend="torch",
            device=self.device,
            pin_memory=self.device.type == "cuda",
            rank=self.ranks.rank,
            world_size=self.ranks.size,
            threads=self.options.threads,
        )

    def _precision(self) -> Any:
        if self.options.amp == "off":
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, {"bf16": torch.bfloat16, "fp16": torch.float16}[self.options.amp])

    def _compiled(self, network: Any) -> Any:
        compile = self.options.compile
        if not compile:
            return network
        return torch.compile(network) if compile is True else torch.compile(network, backend=compile)

    def train(self, until: int | None = None) -> str:
        """Trains until the last step, saves the checkpoint, and returns the hash of its weights.

        Args:
            until: The step at which to stop, from which `resume` continues; the last step for `None`.

        Raises:
            KeyboardInterrupt: After Ctrl-C; the checkpoint is saved, and `resume` continues.
            FloatingPointError: If the loss or the norm of its gradient is not finite; the last checkpoint is kept.
            ValueError: If another process trains in the folder.
        """
        steps, log_every, save_every = self.config["schedule"]["steps"], self.config["log_every"], self.config["save_every"]
        begin, first = time.monotonic(), self.step
        batches = self._batches()
        # A training that ended early has nothing left to train when it is resumed.
        stopped_early = self._out_of_patience()
        alone = _locked(self.run) if self.ranks.rank == 0 else contextlib.nullcontext()
        with alone, _interruptions() as interrupted:
            self._record()
            while self.step < (steps if until is None else min(until, steps)) and not stopped_early:
                metrics, stop = self._update(batches, interrupted.is_set())
                self.window.add(metrics)
                if self.validation is not None and _due(self.config["validation"]["every"], self.step, steps):
                    stopped_early = self._validate()
                if _due(log_every, self.step, steps) or stopped_early:
                    self._log(time.monotonic() - begin, self.step - first)
                if save_every and self.step % save_every == 0 and self.step < steps:
                    self.save()
                if stop:
                    self.save()
                    raise KeyboardInterrupt
            return self.save()

    def _batches(self) -> Iterator[dict[str, Tensor]]:
        """The batches from the current step on."""
        taken = self.step * self.config["optim"].get("accumulate", 1)
        epoch, batch = divmod(taken, len(self.loader))
        position = {"epoch": epoch, "batch": batch}
        self.loader.load_state_dict({**self.loader.state_dict(), **position})
        while True:
            yield from self.loader

    def _update(self, batches: Iterator[dict[str, Tensor]], interrupt: bool) -> tuple[dict[str, float], bool]:
        """A step of the optimizer: its metrics, and whether a rank was interrupted."""
        model, accumulate = self.model, self.config["optim"].get("accumulate", 1)
        self.losses.train_mode()
        self.optimizer.zero_grad()
        names = self.losses.names
        total = torch.zeros(len(names) + 1, device=self.device)
        share = 1.0
        for index in range(accumulate):
            begin = time.monotonic()
            batch = next(batches)
            self.waited += time.monotonic() - begin
            sizes = self.ranks.sizes(len(batch["action"]), self.device)
            share = self.losses.share(sizes)
            self._seed(self.step * accumulate + index)
            self.losses.accumulate(index, accumulate)
            found = self.losses(batch, sizes)
            if found:
                self.scaler.scale(found["loss"] * (share / accumulate)).backward()
                total[:-1] += torch.stack([found[name].detach().float() for name in names]) * (share / accumulate)
        total[-1] = float(interrupt)
        total = self.ranks.add_up(model, total)
        *values, stop = total.tolist()
        metrics = dict(zip(names, values, strict=True))
        if not all(map(_finite, values)):
            raise FloatingPointError(
                f"the loss at training step {self.step + 1} is not finite ({metrics}); lower optim.lr or lengthen "
                "schedule.warmup; the last checkpoint is kept"
            )
        factor = learning_rate(self.config["schedule"], self.step)
        metrics["lr"] = self.config["optim"]["lr"] * factor
        metrics["gradient_norm"] = self.optimizer.step(self.step, factor, self.scaler)
        self.ranks.average_buffers(model, share)
        self.losses.after_step()
        self._move_average()
        self.step += 1
        return metrics, stop > 0

    def _seed(self, batch: int) -> None:
        """Makes random numbers depend on the batch only. Ranks that compute the whole batch draw the same."""
        own = 0 if self.losses.whole_batch else self.ranks.rank
        torch.manual_seed(((self.config["seed"] * 1_000_003 + batch) * 1_009 + own) % (1 << 63))

    def _move_average(self) -> None:
        if self.average is None:
            return
        keep = self.config["optim"]["ema"]
        for name, value in self.model.checkpoint_weights().items():
            self.average[name].lerp_(value.detach(), 1 - keep)

    def _validate(self) -> bool:
        """Logs the losses of validation batches, keeps the best weights, and returns whether training is to stop."""
        assert self.validation is not None
        settings, rows = self.config["validation"], []
        with self._averaged(), torch.no_grad(), self.losses.validating():
            self.validation.set_epoch(0)
            for index, batch in zip(range(settings["batches"]), self.validation, strict=False):
                sizes = self.ranks.sizes(len(batch["action"]), self.device)
                self._seed(-1 - index)
                found = self.losses(batch, sizes)
                share = self.losses.share(sizes)
                values = [
                    found[name].float() * share if found else torch.zeros((), device=self.device) for name in self.losses.names
                ]
                rows.append(self.ranks.add_up(torch.nn.Module(), torch.stack(values)).tolist())
        if not rows:
            raise ValueError(
                "validation.every: the validation episodes have fewer clips than a batch of "
                f"{self.config['data']['batch_size']}; collect more episodes, or lower data.batch_size"
            )
        means = [sum(column) / len(rows) for column in zip(*rows, strict=True)]
        self._write_log({f"validation/{name}": value for name, value in zip(self.losses.names, means, strict=True)})
        if not _finite(means[0]):
            self.save()
            raise FloatingPointError(
                f"the validation loss after step {self.step} is not finite; its weights are kept: look for values that are not "
                "finite in the validation episodes (`swm doctor`), and continue with resume, or train with validation.every=0"
            )
        if self.best is None or means[0] < self.best[1]:
            self.best, self.validations_since_best = (self.step, means[0]), 0
            self._write(self.run / "best", state=None)
        else:
            self.validations_since_best += 1
        return self._out_of_patience()

    def _out_of_patience(self) -> bool:
        """Whether as many validations as `validation.patience` have followed the best one."""
        return bool(0 < self.config["validation"]["patience"] <= self.validations_since_best)

    @contextlib.contextmanager
    def _averaged(self) -> Iterator[None]:
        """With the average in place of the trained weights, if there is one."""
        if self.average is None:
            yield
            return
        own = {name: value.clone() for name, value in self.model.checkpoint_weights().items()}
        try:
            self._load(self.average)
            yield
        finally:
            self._load(own)

    def _load(self, weights: Mapping[str, Tensor]) -> None:
        with torch.no_grad():
            for name, value in self.model.checkpoint_weights().items():
                value.copy_(weights[name])

    def save(self) -> str:
        """Writes the checkpoint, from which training can continue, and returns the hash of its weights."""
        state = {"step": self.step, "best": self.best, "looks": self.validations_since_best}
        return self._write(self.run, {**state, **self.window.stored()})

    def _write(self, run: Path, state: Mapping[str, Any] | None) -> str:
        weights = self.model.checkpoint_weights()
        stored = self.model.stored
        device = {"device": f"{self.device} (torch)"}
        stored.manifest.update(device)
        parts: dict[str, Any] = {}
        if state is not None:
            moments = self.optimizer.moments(self.step, self.scaler)
            parts = {"state": state, "moments": moments, "raw": None if self.average is None else weights}
        averaged = weights if self.average is None else self.average
        return self.ranks.first(lambda: write(run, stored, averaged, replace=True, **parts))  # type: ignore[no-any-return]

    def _log(self, elapsed: float, done: int) -> None:
        """Writes the means of the metrics since the last line."""
        means, self.window = self.window.means(), Window()
        clips = done * self.config["optim"].get("accumulate", 1) * self.config["data"]["batch_size"]
        rates = {"clips_per_second": clips / elapsed, "data_wait": self.waited / elapsed, "seconds": elapsed}
        self._write_log({**means, **rates})

    def _write_log(self, values: Mapping[str, float]) -> None:
        if self.ranks.rank == 0:
            # JSON has no values that are not finite. In half precision, the gradient of a step that is left out is not.
            row = {name: value if _finite(value) else None for name, value in values.items()}
            with open(self.run / "train.jsonl", "a", encoding="utf-8") as file:
                file.write(json.dumps({"step": self.step, **row}) + "\n")


class Window:
    """The metrics since the last line of the log; stored in `state.json`, so that a continued training writes equal lines.

    Args:
        sums: The sum of each metric.
        count: The number of steps.
    """

    def __init__(self, sums: Mapping[str, float] | None = None, count: int = 0) -> None:
        self.sums, self.count = dict(sums or {}), count
        self.last: Mapping[str, float] = {}

    @classmethod
    def of(cls, stored: Any, names: Sequence[str]) -> Window:
        """The window in the state of a run with these losses; an empty one if the state has none, or that of other losses."""
        names = [*names, "gradient_norm"]
        if not stored or len(stored["sums"]) != len(names):
            return cls()
        # JSON has no values that are not finite.
        sums = [float("nan") if value is None else value for value in stored["sums"]]
        return cls(dict(zip(names, sums, strict=True)), stored["count"])

    def stored(self) -> dict[str, Any]:
        """The part of the state of a run that `of` reads."""
        if not self.count:
            return {}
        return {"window": {"sums": [value if _finite(value) else None for value in self.sums.values()], "count": self.count}}

    def add(self, metrics: Mapping[str, float]) -> None:
        """Adds the metrics of a step."""
        self.sums = {name: self.sums.get(name, 0.0) + value for name, value in metrics.items() if name != "lr"}
        self.count, self.last = self.count + 1, metrics

    def means(self) -> dict[str, float]:
        """The mean of each metric, and the last learning rate."""
        means = {name: total / self.count for name, total in self.sums.items()}
        norm = means.pop("gradient_norm")
        return {**means, "lr": self.last["lr"], "gradient_norm": norm}


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keeps other writers away from a folder, as the engine's trainings do."""
    file = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(
                f"{folder}: another process writes to it; wait until that process has ended, or choose another folder"
            ) from error
        except OSError:
            # Some network file systems have no locks.
            pass
        yield
    finally:
        os.close(file)


def _check_compile(compile: bool | str, device: torch.device) -> None:
    """Checks that `torch.compile` works, before anything is written.

    Raises:
        ValueError: If there is no such backend, or it lacks something, such as a package or a compiler.
    """
    if compile is False:
        return
    if isinstance(compile, str):
        import torch._dynamo

        if compile not in torch._dynamo.list_backends(exclude_tags=()):
            known = ", ".join(torch._dynamo.list_backends())
            raise ValueError(f"compile: {compile!r}; expected true, false or a backend, such as {known}")
    try:
        torch.compile(lambda x: x + 1, backend="inductor" if compile is True else compile)(torch.zeros(2, device=device))
    except Exception as error:
        # The rest of the message is about the variables with which torch says more.
        reason = " ".join(str(error).split("\n\n")[0].split())
        given = "true" if compile is True else repr(compile)
        raise ValueError(f"compile: {given} does not work here ({reason}); install what it needs, or leave it out") from error


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
        # A device without data, such as meta, has no values.
        float(torch.zeros(1, device=device))
    except (RuntimeError, AssertionError) as error:
        raise ValueError(f"device: {name!r} is not available ({error}); choose cpu, or another device of torch") from error
    return device


def _due(every: int, done: int, steps: int) -> bool:
    return every > 0 and (done % every == 0 or done == steps)


def _finite(value: float) -> bool:
    return value - value == 0


@contextlib.contextmanager
def _interruptions() -> Iterator[threading.Event]:
    """An event that Ctrl-C sets; the second Ctrl-C interrupts at once."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return

    def handle(number: int, frame: Any) -> None:
        if event.is_set():
            raise KeyboardInterrupt
        event.set()

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield event
    finally:
        signal.signal(signal.SIGINT, before)
