"""The engine's models: checkpoints of LeWM, PLDM, DINO-WM, TD-MPC2, GCBC, GCIVL, GCIQL, SAC.

    swm.wm.train("lewm", data="rooms", out="lewm-rooms", preset="tiny")
    model = swm.wm.load("lewm-rooms")  # a name under $STABLEWM_HOME/checkpoints, a path, or a name of the zoo
    solver = swm.solver.CEMSolver(model)

Planning with these models runs in the engine, without Python.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import _engine, _options
from ..planning.adapter import has_torch
from ..planning.solver.engine import last_step

__all__ = ["Model", "load", "train"]


class Model:
    """A checkpoint, for planning (`get_cost`) or for acting (`swm.policy.FeedForwardPolicy`).

    The weights stay in memory: a training that replaces them does not change the model. Copies and other processes load the
    checkpoint again, and refuse other weights.

    Args:
        name: The path of a checkpoint or a capsule, a name under `$STABLEWM_HOME/checkpoints`, or `zoo:` and the name of a
            capsule (`swm zoo` lists them). An existing path counts before a name.
        device: `cpu`, or a GPU if the engine was built with GPU support.
        objective: The planning objective, a dict with `terms` and `constraints`, such as
            `{"terms": [{"term": "control", "weight": 0.01}]}`; `None` for the model's own cost.
        trust: Whether the checkpoint may choose an environment that imports a Python module, which `get_action` makes.
    """

    def __init__(
        self, name: str | os.PathLike[str], device: str = "cpu", objective: dict[str, Any] | None = None, *, trust: bool = False
    ) -> None:
        name = os.fspath(name)
        self._engine_model = _engine.Model(name, device, json.dumps(objective), bool(trust))
        self._arguments = (name, device, objective, bool(trust))
        #: The checkpoint info: `family`, `env`, `image`, `action_block`, `history`, `config`, `weights`, `action_mean` and
        #: `action_std`.
        self.card: dict[str, Any] = json.loads(self._engine_model.info)

    def __reduce__(self) -> Any:
        """The arguments: a copy loads the checkpoint again, which must have the same weights."""
        return _opened, (*self._arguments, self.card["weights"])

    @property
    def path(self) -> str:
        """The path of the checkpoint."""
        return self._engine_model.path

    @property
    def action_block(self) -> int:
        """Environment steps in one model step."""
        return int(self.card["action_block"])

    @property
    def _engine_policy(self) -> Any:
        return self._engine_model

    def get_cost(self, info_dict: dict[str, Any], action_candidates: Any) -> Any:
        """The costs of candidate action sequences.

        Args:
            info_dict: Infos `(B, T, ..)`, or `(B, S, T, ..)` if they are repeated for every candidate. The number of
                dimensions of `pixels` and `goal` (frames `(height, width, 3)` of `uint8`) decides between the two.
            action_candidates: Candidates `(B, S, H, A)` in the model's units, a tensor or an array.

        Returns:
            Costs `(B, S)`: a tensor for a tensor, else an array.
        """
        torch_in = hasattr(action_candidates, "detach")
        candidates = action_candidates.detach().cpu().numpy() if torch_in else np.asarray(action_candidates)
        candidates = np.ascontiguousarray(candidates, dtype=np.float32)
        if candidates.ndim != 4:
            raise ValueError(f"action_candidates: got shape {candidates.shape}, expected (B, S, H, A)")
        if 0 in candidates.shape:
            raise ValueError(
                f"action_candidates: got shape {candidates.shape}, expected (B, S, H, A), each at least 1; "
                "give at least one candidate of at least one model step"
            )
        given = {
            key: value
            for key, value in info_dict.items()
            if not isinstance(value, (list, str, Mapping)) and not key.startswith("_")
        }
        frame_dims = [value.ndim for key, value in given.items() if key in ("pixels", "goal")]
        # The repetitions of an info are equal, so the first one is used.
        repeated = bool(frame_dims) and max(frame_dims) == 6
        infos = {key: last_step(value[:, 0] if repeated else value) for key, value in given.items()}
        for key, value in infos.items():
            if len(value) != len(candidates):
                raise ValueError(
                    f"info_dict[{key!r}]: got {len(value)} rows, expected {len(candidates)}, one for each environment of "
                    f"action_candidates {candidates.shape}; give infos and candidates of the same environments"
                )
        costs = self._engine_model.cost(infos, candidates)
        if torch_in and has_torch():
            import torch

            return torch.from_numpy(costs).to(action_candidates.device)
        return costs

    def get_action(self, info: dict[str, Any], **kwargs: Any) -> Any:
        """The actions `(B, A)` for infos `(B, T, ..)`, in the environment's units; a tensor if an info is a tensor."""
        given = {key: value for key, value in info.items() if not isinstance(value, (list, str, Mapping)) and key[0] != "_"}
        actions = self._engine_model.act({key: last_step(value) for key, value in given.items()})
        if has_torch() and any(hasattr(value, "detach") for value in given.values()):
            import torch

            return torch.from_numpy(actions)
        return actions

    def __repr__(self) -> str:
        return f"Model({self.card['family']}, {self.path!r})"


def _opened(name: str, device: str, objective: dict[str, Any] | None, trust: bool, weights: str | None = None) -> Model:
    model = Model(name, device, objective, trust=trust)
    if weights not in (None, model.card["weights"]):
        raise ValueError(
            f"checkpoint {name}: its weights were replaced since the model was loaded; load it again (swm.wm.load)"
        )
    return model


def load(name: str | os.PathLike[str], device: str = "cpu", **kwargs: Any) -> Model:
    """Loads a checkpoint or a capsule by name or path, as `Model`."""
    return Model(name, device, **kwargs)


def train(
    model: str,
    *,
    data: str | None = None,
    env: str | None = None,
    out: str | None = None,
    preset: str | None = None,
    device: str = "cpu",
    resume: bool = False,
    **overrides: Any,
) -> str:
    """Trains a model with `swm train`.

    Args:
        model: A model family, such as `lewm` (`swm models` lists them).
        data: The dataset to train on, for families that learn from a dataset.
        env: The environment to train in, for families that learn online.
        out: The checkpoint's name or path; for `None`, the name `MODEL-DATASET` or `MODEL-ENV`.
        preset: The name of a configuration; the first one of the family for `None`.
        device: `cpu`, or a GPU if the engine was built with GPU support.
        resume: Whether to continue an interrupted training of the checkpoint.
        **overrides: Settings that replace the preset's settings, with `__` for dots: `schedule__steps=1000`. Booleans,
            sequences, dicts and values of numpy are written as TOML; a text is as on the command line.

    Returns:
        `out`, or the name that stands for `None`.
    """
    if out is None and env is not None:
        out = f"{model}-{env.rpartition('/')[2].partition(',')[0]}"
    elif out is None and data is not None:
        out = f"{model}-{Path(data).stem}"
    arguments = ["swm", "train", model]
    for flag, value in (("--data", data), ("--env", env), ("--output", out), ("--preset", preset), ("--device", device)):
        if value is not None:
            arguments += [flag, str(value)]
    arguments += ["--resume"] * bool(resume)
    arguments += [f"{key.replace('__', '.')}={_options.setting(value, key)}" for key, value in overrides.items()]
    _command(arguments)
    return str(out)


#: A program that runs the command line and interrupts itself, as Ctrl-C does, when its standard input ends.
_CHILD = """
import sys

# `python -c` puts the current folder first, where a file may have the name of a module.
if sys.path[:1] == [""]:
    del sys.path[0]
sys.path.insert(0, sys.argv[1])

import os, signal, threading

from stable_worldmodel import _engine


def interrupt_at_end_of_input():
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGINT)


threading.Thread(target=interrupt_at_end_of_input, daemon=True).start()
sys.exit(_engine.command(sys.argv[2:]))
"""


def _command(arguments: list[str], shows: bool = True) -> None:
    """Runs the command line in a child process, so that signals and logs of this interpreter are not affected.

    The command saves its state and ends when this interpreter is interrupted or ends. `shows` is whether its output is shown.
    """
    package = Path(__file__).resolve().parent.parent.parent
    # In a terminal the command prints its progress itself; in a notebook its output is copied line by line.
    output = None if shows and sys.stderr.isatty() else subprocess.PIPE
    child = subprocess.Popen(
        [sys.executable, "-c", _CHILD, str(package), *arguments],
        stdin=subprocess.PIPE,
        stdout=output,
        stderr=None if output is None else subprocess.STDOUT,
        text=True,
        errors="replace",
        env=os.environ,
        start_new_session=True,
    )
    last_line = ""
    try:
        for line in child.stdout or ():
            if shows:
                sys.stderr.write(line)
            # Hints may follow an error.
            if line.strip() and not last_line.startswith("error: "):
                last_line = line
        child.wait()
    except BaseException:
        child.stdin.close()  # type: ignore[union-attr]
        child.wait()
        raise
    finally:
        for stream in (child.stdin, child.stdout):
            if stream is not None:
                stream.close()
    reason = last_line.removeprefix("error: ").strip() or "see its output"
    if child.returncode == 130:
        raise KeyboardInterrupt
    if child.returncode:
        kind = ValueError if child.returncode == 2 else RuntimeError
        raise kind(f"swm {arguments[1]} ended with code {child.returncode}: {reason}")
