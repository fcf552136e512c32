"""`Pretrained`: modules that load and save the engine's checkpoints.

model = swm.wm.LeWM.from_pretrained("lewm-rooms")  # also of a subclass
model.save_pretrained("lewm-changed")  # `swm eval lewm-changed` plans with it
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import Self

from .. import _engine
from ._located import check_name

__all__ = ["Pretrained", "Stored", "stored_names"]

#: The ends of the names of buffers that a checkpoint holds; other buffers, such as masks, follow from the sizes.
_BUFFERS = ("running_mean", "running_var", "scale.value")


@dataclass
class Stored:
    """What a checkpoint of the engine holds besides weights.

    Attributes:
        file: The content of `config.json`: family, configuration, and statistics of the dataset.
        manifest: The provenance: the content of `manifest.json`.
    """

    file: dict[str, Any]
    manifest: dict[str, Any] = field(default_factory=dict)

    @property
    def config(self) -> dict[str, Any]:
        """The training configuration."""
        return self.file["config"]  # type: ignore[no-any-return]


def stored_names(model: nn.Module) -> list[str]:
    """The names of the weights of a module that a checkpoint holds: parameters and running statistics."""
    parameters = {name for name, _ in model.named_parameters(remove_duplicate=False)}
    return [name for name in model.state_dict() if name in parameters or name.endswith(_BUFFERS)]


class Pretrained(nn.Module):
    """Base class of modules that are the same model as one of the engine.

    Actions of a model are in the model's units; `process` converts them.
    """

    #: Environment steps in one model step.
    action_block: int = 1
    #: The checkpoint that the module was loaded from; `None` for a module that was built otherwise.
    stored: Stored | None = None

    @classmethod
    def from_pretrained(cls, name: str | os.PathLike[str]) -> Self:
        """Loads a checkpoint of the engine as a module of this class, in evaluation mode.

        Args:
            name: The path of a run or of a capsule, a name under `$STABLEWM_HOME/checkpoints`, or `zoo:` and the name of a
                capsule. An existing path counts before a name.

        Raises:
            FileNotFoundError: If there is no such checkpoint.
            TypeError: If it holds another model.
        """
        from .checkpoints import load

        return load(name, cls)

    def save_pretrained(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> str:
        """Writes the model as a checkpoint of the engine, which `swm.wm.load` and `swm eval` read.

        Args:
            path: A name under `$STABLEWM_HOME/checkpoints`, or a path with a slash.
            overwrite: Whether a checkpoint at the path is replaced.

        Returns:
            The hash of the weights.

        Raises:
            ValueError: If the module was not loaded from a checkpoint of the engine, its weights are not those of its
                configuration, or the folder holds a checkpoint already.
        """
        if self.stored is None:
            raise ValueError(
                f"{type(self).__name__}.save_pretrained: the module has no configuration of the engine; load it with "
                "from_pretrained, or create it with stable_worldmodel.train.Trainer"
            )
        run = run_path(path)
        if overwrite and (run / "config.json").exists():
            # It would be read in place of the checkpoint, which is in a folder of its own.
            raise ValueError(f"{run}: holds a config.json; give the folder of a run, or another folder")
        return write(run, self.stored, self.checkpoint_weights(), replace=overwrite)

    def checkpoint_weights(self) -> dict[str, Tensor]:
        """The weights under the names of a checkpoint of the engine."""
        values = self.state_dict()
        return {self._checkpoint_name(name): values[name] for name in stored_names(self)}

    def _checkpoint_name(self, name: str) -> str:
        """The name of a weight in a checkpoint, of its name in this module."""
        return name

    @property
    def process(self) -> dict[str, Any]:
        """The scaler of the actions, which policies use by default; empty for a module without a checkpoint."""
        if self.stored is None:
            return {}
        from ..data.normalization import ZScoreScaler

        scale = self.stored.file["facts"]["action"]
        mean, std = (np.asarray(scale[name], np.float32) for name in ("mean", "std"))
        return {"action": ZScoreScaler(mean, std)}


def run_path(name: str | os.PathLike[str]) -> Path:
    """The folder of a checkpoint to write: a path, or a name under `$STABLEWM_HOME/checkpoints`."""
    path = check_name("path", name)
    if path.is_absolute() or len(path.parts) > 1 or str(name).startswith("."):
        return path
    return Path(_engine.home()) / "checkpoints" / path


def write(
    run: Path,
    stored: Stored,
    weights: Mapping[str, Tensor],
    *,
    state: Mapping[str, Any] | None = None,
    moments: Mapping[str, Tensor] | None = None,
    raw: Mapping[str, Tensor] | None = None,
    replace: bool = False,
) -> str:
    """Writes a checkpoint in the run folder `run`, and returns the hash of its weights.

    Args:
        run: The folder.
        stored: Configuration and provenance.
        weights: The weights, by the names of the checkpoint.
        state: The progress of a training that can be continued.
        moments: The state of the optimizer, with `state`.
        raw: The trained weights, if `weights` are their moving average.
        replace: Whether a checkpoint in the folder is replaced.
    """
    manifest = {**stored.manifest, "libraries": {"torch": torch.__version__.split("+")[0]}}
    texts = json.dumps({"file": stored.file, "manifest": manifest, "state": state})
    kept = None if raw is None else _arrays(raw)
    return _engine.save_checkpoint(str(run), texts, _arrays(weights), _arrays(moments or {}), kept, replace)


def _arrays(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    return {name: np.ascontiguousarray(value.detach().float().cpu().numpy()) for name, value in tensors.items()}
