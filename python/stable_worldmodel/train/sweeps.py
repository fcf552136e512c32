"""Trainings that Hydra starts: `--multirun` and the other flags of its command line."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

from .. import _engine
from .options import Options, parsed

__all__ = ["run"]

#: The dataset has another name in Hydra's configuration, whose `data` is a table of settings.
_DATASET = "dataset"
#: The options that are names or paths.
_NAMES = (_DATASET, "out", "preset", "device")
#: What Hydra reads as a number.
_NUMBER = re.compile(r"[+-]?(\d[\d_]*(\.[\d_]*)?|\.\d[\d_]*)(e[+-]?[\d_]+)?", re.IGNORECASE)


def run(family: str, arguments: Sequence[str], train: Callable[[Options], object]) -> None:
    """Runs Hydra's application, which calls `train` for each of its jobs.

    Args:
        family: The model.
        arguments: The command line without the family.
        train: Trains a model.

    Raises:
        ValueError: If Hydra is not installed, a setting is given twice, or the family or the preset is unknown.
    """
    try:
        import hydra
        from hydra.core.config_store import ConfigStore
        from hydra.core.hydra_config import HydraConfig
        from omegaconf import OmegaConf
    except ModuleNotFoundError as error:
        flags = ", ".join(argument for argument in arguments if argument.startswith("-"))
        raise ValueError(f"{flags}: flags are those of Hydra, which is not installed: pip install hydra-core") from error

    named = [_DATASET + argument[4:] if argument.startswith("data=") else argument for argument in arguments]
    given_keys = [argument.lstrip("+~").partition("=")[0] for argument in named if not argument.startswith("-")]
    for key in given_keys:
        # Hydra would take the last value.
        if given_keys.count(key) > 1:
            raise ValueError(f"{key}: given twice; give it once, for a sweep with several values: {key}=A,B")
    named = [_quoted(argument) for argument in named]
    # Hydra takes flags before overrides only.
    named.sort(key=lambda argument: "=" in argument and not argument.startswith("-"))
    preset = next((argument.partition("=")[2] for argument in arguments if argument.startswith("preset=")), None)
    own = {item.name: item.default for item in fields(Options) if item.name not in ("family", "data", "settings")}
    config = {_DATASET: "???", **own, **json.loads(_engine.training_config(family, preset, []))}
    ConfigStore.instance().store(name="train", node=OmegaConf.create(config))

    def job(config: Any) -> None:
        hydra_config = HydraConfig.get()
        given = []
        for override in hydra_config.overrides.task:
            key = override.lstrip("+~").partition("=")[0]
            value = OmegaConf.to_container(OmegaConf.create({"value": OmegaConf.select(config, key)}))["value"]
            text = str(value) if key in own or key == _DATASET else _toml(value)
            given.append(f"{'data' if key == _DATASET else key}={text}")
        if not any(argument.startswith("out=") for argument in given) and hydra_config.mode.name == "MULTIRUN":
            given.append(f"out={hydra_config.runtime.output_dir}/run")
        train(parsed(family, given))

    sys.argv = [sys.argv[0], *named]
    hydra.main(version_base="1.3", config_path=None, config_name="train")(job)()


def _quoted(argument: str) -> str:
    """An argument of the command line, with quotes around names that Hydra would read as numbers, such as `2026_11_29`."""
    key, separator, value = argument.partition("=")
    if key.lstrip("+") not in _NAMES or any(sign in value for sign in "'\"([{"):
        return argument
    names = [f"'{name}'" if _NUMBER.fullmatch(name) else name for name in value.split(",")]
    return f"{key}{separator}{','.join(names)}"


def _toml(value: Any) -> str:
    """A value as in a TOML file, in one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return json.dumps(value)
