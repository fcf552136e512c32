"""`Options`: what a training needs besides the settings of `swm train`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from .. import _files, _options

__all__ = ["Options", "called", "parsed"]

#: The most threads of the engine.
_MOST_THREADS = 1024
#: The most processes of a training.
_MOST_WORKERS = 4096
#: The values that switch something on or off.
_FLAGS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}


@dataclass
class Options:
    """A training.

    Attributes:
        family: The model: `lewm`, `pldm`, `dino_wm`, `tdmpc2`, `gcbc`, `gcivl` or `gciql`.
        data: The dataset: a path or a name.
        out: The checkpoint to write: a path or a name; `FAMILY-DATASET` for `None`.
        preset: The name of a configuration, or a TOML file; the first one of the family for `None`.
        device: `cpu`, `cuda`, or another device of torch; `auto` is `cuda` if there is a GPU.
        amp: The precision of networks: `off` (single), `bf16` or `fp16`.
        compile: Whether `torch.compile` compiles the networks; or the name of its backend.
        resume: Whether an interrupted training is continued.
        threads: Threads that prefetch batches.
        workers: Processes on a Ray cluster that train the model together (`stable_worldmodel.ray.fit`); 0 for this process,
            or those of `torchrun`.
        settings: `key=value` settings of the configuration, as for `swm train`.
    """

    family: str
    data: str
    out: str | None = None
    preset: str | None = None
    device: str = "auto"
    amp: str = "off"
    compile: bool | str = False
    resume: bool = False
    threads: int = 2
    workers: int = 0
    settings: Sequence[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.data:
            raise ValueError("data: the name of the dataset is empty; name one with data=PATH")
        if self.out == "":
            raise ValueError("out: the name of the checkpoint is empty; leave it out, or name one with out=PATH")
        if self.out is not None:
            _files.local("out", self.out)
        if not 0 <= self.threads <= _MOST_THREADS:
            raise ValueError(f"threads: {self.threads}; expected 0 to {_MOST_THREADS}")
        if not 0 <= self.workers <= _MOST_WORKERS:
            raise ValueError(f"workers: {self.workers}; expected 0 to {_MOST_WORKERS}")
        if self.amp not in ("off", "bf16", "fp16"):
            raise ValueError(f"amp: {self.amp!r}; expected off, bf16 or fp16")

    @property
    def run(self) -> Path:
        """The folder of the checkpoint."""
        from ..wm.pretrained import run_path

        return run_path(self._name)

    def command(self) -> list[str]:
        """The command of `swm train` with this model, dataset and configuration, which continues the training as well."""
        preset = [] if self.preset is None else ["--preset", str(self.preset)]
        return ["swm", "train", self.family, "--data", self.data, *preset, "--output", self._name, *self.settings]

    @property
    def _name(self) -> str:
        """The path or the name of the checkpoint."""
        return str(self.out or f"{self.family}-{Path(self.data).stem}")


def parsed(family: str, arguments: Sequence[str]) -> Options:
    """The options of a command line: `data=PATH`, other options, and settings of the configuration.

    Raises:
        ValueError: If an argument is no `key=value`, an option is given twice, or the dataset is missing.
    """
    own = {item.name: item.default for item in fields(Options) if item.name not in ("family", "settings")}
    given: dict[str, Any] = {}
    settings = []
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals:
            raise ValueError(f"{argument!r}: expected KEY=VALUE, such as data=rooms or model.latent=64")
        if key in given:
            raise ValueError(f"{key}: given twice, as {given[key]!r} and {value!r}; give it once")
        if key in own:
            given[key] = _value(key, value, own[key])
        else:
            settings.append(argument)
    if "data" not in given:
        raise ValueError("data: no dataset is given; name one with data=PATH")
    return Options(family, settings=settings, **given)


def called(family: str, data: str, settings: Iterable[str], options: Mapping[str, Any]) -> Options:
    """The options of a call in Python, whose keyword arguments with `__` for dots are settings.

    Raises:
        TypeError: If a keyword argument is neither an option nor a setting.
    """
    known = [item.name for item in fields(Options) if item.name not in ("family", "data", "settings")]
    own = {key: value for key, value in options.items() if "__" not in key}
    for key, value in own.items():
        if key not in known:
            raise TypeError(
                f"{key}: there is no such option; the options are {', '.join(known)}; "
                f"give a setting of the configuration as settings=[{f'{key}={value}'!r}]"
            )
    more = {key: value for key, value in options.items() if "__" in key}
    return Options(family, data, settings=[*settings, *settings_of(more)], **own)


def _value(key: str, value: str, default: Any) -> Any:
    """The value of an option, of the type of its default."""
    if isinstance(default, bool):
        if value.lower() in _FLAGS:
            return _FLAGS[value.lower()]
        if key == "compile":
            return value
        raise ValueError(f"{key}: {value!r}; expected true or false")
    if isinstance(default, int):
        if not value.isdecimal():
            raise ValueError(f"{key}: {value!r}; expected a whole number")
        return int(value)
    return None if default is None and value == "null" else value


def settings_of(overrides: Mapping[str, Any]) -> list[str]:
    """Settings given as keyword arguments, with `__` for dots, as `key=value`."""
    return [f"{key.replace('__', '.')}={_options.setting(value, key)}" for key, value in overrides.items()]
