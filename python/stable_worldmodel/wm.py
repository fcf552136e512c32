"""Our own models: checkpoints of LeWM, PLDM, DINO-WM, TD-MPC2, GCBC, GCIVL, GCIQL, SAC.

model = swm.wm.load("lewm-rooms")            # a name under $STABLEWM_HOME/checkpoints, or a path
solver = swm.solver.CEMSolver(model)         # planning runs in the engine, without Python
swm.wm.train("lewm", data="rooms", out="lewm-rooms", preset="tiny")
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

from . import _engine
from .planning import has_torch
from .solver import now

__all__ = ["Model", "load", "load_pretrained", "train"]


class Model:
    """A checkpoint: to plan in (`get_cost`), or to act with (`swm.policy.FeedForwardPolicy`).

    Args:
        name: A name under `$STABLEWM_HOME/checkpoints`, or a path.
        device: `cpu`, or a GPU where the engine was built with one.
        objective: What plans are for besides the model's own cost: a dict as `swm eval --objective` reads.
    """

    def __init__(self, name: str, device: str = "cpu", objective: dict[str, Any] | None = None) -> None:
        self._engine_model = _engine.Model(str(name), device, json.dumps(objective))
        #: What it is: `family`, `env`, `image`, `action_block`, `history`, `config`, `weights` and more.
        self.card: dict[str, Any] = json.loads(self._engine_model.info)

    @property
    def path(self) -> str:
        """Where it is."""
        return self._engine_model.path

    @property
    def action_block(self) -> int:
        """Environment steps in one model step."""
        return int(self.card["action_block"])

    @property
    def _engine_policy(self) -> str:
        return self.path

    def get_cost(self, info_dict: dict[str, Any], action_candidates: Any) -> Any:
        """What candidates `(B, S, H, A)`, in the model's units, cost: `(B, S)`. torch in, torch out; numpy in, numpy out.

        Infos are `(B, T, ..)`, or `(B, S, T, ..)`: the same for every candidate. Pictures, `(height, width, 3)` bytes, show
        which.
        """
        torch_in = hasattr(action_candidates, "detach")
        candidates = action_candidates.detach().cpu().numpy() if torch_in else np.asarray(action_candidates)
        candidates = np.ascontiguousarray(candidates, dtype=np.float32)
        if candidates.ndim != 4:
            raise ValueError(f"action_candidates: got shape {candidates.shape}, expected (B, S, H, A)")
        given = {
            key: value
            for key, value in info_dict.items()
            if not isinstance(value, (list, str, Mapping)) and not key.startswith("_")
        }
        pictures = [value.ndim for key, value in given.items() if key in ("pixels", "goal")]
        # Infos repeated for every candidate say nothing new.
        repeated = bool(pictures) and max(pictures) == 6
        infos = {key: now(value[:, 0] if repeated else value) for key, value in given.items()}
        costs = self._engine_model.cost(infos, candidates)
        if torch_in and has_torch():
            import torch

            return torch.from_numpy(costs).to(action_candidates.device)
        return costs

    def get_action(self, info: dict[str, Any], **kwargs: Any) -> Any:
        """What a model that acts does for infos `(B, T, ..)`: `(B, ..)`, in the environment's units. torch in, torch out."""
        given = {key: value for key, value in info.items() if not isinstance(value, (list, str, Mapping)) and key[0] != "_"}
        actions = self._engine_model.act({key: now(value) for key, value in given.items()})
        if has_torch() and any(hasattr(value, "detach") for value in given.values()):
            import torch

            return torch.from_numpy(actions)
        return actions

    def __repr__(self) -> str:
        return f"Model({self.card['family']}, {self.path!r})"


def load(name: str, device: str = "cpu", **kwargs: Any) -> Model:
    """A checkpoint by name or path."""
    return Model(name, device, **kwargs)


load_pretrained = load


def train(
    model: str,
    *,
    data: str | None = None,
    env: str | None = None,
    out: str | None = None,
    preset: str | None = None,
    device: str = "cpu",
    **overrides: Any,
) -> str:
    """Trains a model, as `swm train` does; returns the checkpoint's place.

    Args:
        model: A family, such as `lewm` (`swm models` lists them).
        data: A dataset to learn from, or `env`: an environment to play in.
        out: The checkpoint's name or path.
        preset: A configuration; the first one of the family for `None`.
        **overrides: What differs from it, with `__` for dots: `train__steps=1000`.
    """
    words = ["swm", "train", model]
    for flag, value in (("--data", data), ("--env", env), ("--output", out), ("--preset", preset), ("--device", device)):
        if value is not None:
            words += [flag, str(value)]
    words += [f"{key.replace('__', '.')}={value}" for key, value in overrides.items()]
    _command(words)
    return str(out)


#: Runs the command line in a process of its own, which stops, as on Ctrl-C, when its standard input ends.
_CHILD = """
import os, signal, sys, threading

sys.path.insert(0, sys.argv[1])
from stable_worldmodel import _engine


def follow():
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGINT)


threading.Thread(target=follow, daemon=True).start()
sys.exit(_engine.command(sys.argv[2:]))
"""


def _command(words: list[str]) -> None:
    """Runs the command line beside this interpreter, whose signals and logs stay its own.

    It saves what it has and ends when it is interrupted, or when this interpreter ends in any way.
    """
    package = Path(__file__).resolve().parent.parent
    # A terminal is shown progress by the command itself; notebooks are told what it says.
    told = None if sys.stderr.isatty() else subprocess.PIPE
    child = subprocess.Popen(
        [sys.executable, "-c", _CHILD, str(package), *words],
        stdin=subprocess.PIPE,
        stdout=told,
        stderr=None if told is None else subprocess.STDOUT,
        text=True,
        errors="replace",
        env=os.environ,
        start_new_session=True,
    )
    said = ""
    try:
        for line in child.stdout or ():
            sys.stderr.write(line)
            said = line
        child.wait()
    except BaseException:
        child.stdin.close()  # type: ignore[union-attr]
        child.wait()
        raise
    finally:
        for stream in (child.stdin, child.stdout):
            if stream is not None:
                stream.close()
    why = said.removeprefix("error: ").strip() or "what it printed says why"
    if child.returncode == 130:
        raise KeyboardInterrupt
    if child.returncode:
        kind = ValueError if child.returncode == 2 else RuntimeError
        raise kind(f"swm {words[1]} ended with code {child.returncode}: {why}")
