"""Training of the baselines in torch, on any device.

    python -m stable_worldmodel.train lewm data=rooms out=lewm-rooms preset=tiny model.latent=4
    torchrun --nproc-per-node 2 -m stable_worldmodel.train pldm data=rooms

The settings are those of `swm train`, and so is the checkpoint: `swm eval lewm-rooms` plans with it, and
`swm train --resume` and this package continue each other's runs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .options import Options, called, parsed

if TYPE_CHECKING:
    from .loop import Trainer

__all__ = ["Options", "Trainer", "parsed", "train"]


def train(family: str, data: Any, kind: Any = None, *, settings: Any = (), **options: Any) -> str:
    """Trains a model, and returns the folder of its checkpoint.

    Args:
        family: The model: `lewm`, `pldm`, `dino_wm`, `tdmpc2`, `gcbc`, `gcivl` or `gciql`.
        data: The dataset: a path or a name.
        kind: A class derived from that of the family, for models with other methods. Training calls them; a class with a
            method that it could not call is refused.
        settings: Settings of the configuration, such as `["model.latent=4"]`.
        **options: The other attributes of `Options`; names with `__` are settings, such as `schedule__steps=1000`.
    """
    given = called(family, str(data), settings, options)
    if given.workers:
        if kind is not None:
            raise ValueError(
                f"workers: {given.workers} processes cannot have the class {kind.__name__}; leave out one of the two"
            )
        from ..ray.fit import fitted

        return fitted(given)
    from .loop import Trainer
    from .memory import explained, sized

    given = sized(given)
    with explained(given):
        trainer = Trainer(given, kind)
        try:
            trainer.train()
        finally:
            trainer.ranks.leave()
    return str(trainer.run)


def __getattr__(name: str) -> Any:
    if name == "Trainer":
        from .loop import Trainer

        return Trainer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
