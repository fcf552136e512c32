"""Checkpoints as torch modules.

model = load_pretrained("lewm-rooms")  # a run of `swm train`, or a folder with `weights.pt` and `config.json`
save_pretrained(model, "mine", config=config)
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import nn

from .. import _engine, _files
from ._bounds import bounded
from ._build import build
from ._located import check_name, home_of, is_stored, located
from ._weights import check_numbers, lacks_memory, load_into, read_state_dict
from .checkpoints import module_of

__all__ = ["load_pretrained", "save_pretrained"]

#: The entry of a file of weights that says that `save_pretrained` wrote it.
_MARK = "stable_worldmodel.json"

#: Modules without weights, beside those with a tensor in the file.
_FREE_MODULES = 4096

#: The largest integer of a configuration, unless the file of the weights has more bytes: lists and masks can have as many
#: elements before there is a tensor to count.
_LARGEST = 1 << 20

#: The largest size of a configuration, in bytes.
_MOST_SETTINGS = 16 << 20


def save_pretrained(
    model: nn.Module,
    run_name: str,
    config: Any = None,
    config_key: str | None = None,
    filename: str = "weights.pt",
    cache_dir: str | os.PathLike[str] | None = None,
) -> None:
    """Saves a model's weights and configuration, for `load_pretrained`. Older ones of this name are replaced.

    Args:
        model: The model.
        run_name: The name of the folder under `$STABLEWM_HOME/checkpoints`.
        config: The configuration: a mapping (also of OmegaConf) whose `_target_` names the model's class, with its
            arguments. Without one, only the weights are saved, and a warning says so, as it does where there is no `_target_`.
        config_key: The key of the model's part of the configuration.
        filename: The file of the weights.
        cache_dir: A folder in place of `$STABLEWM_HOME`.

    Raises:
        ValueError: If `run_name` is no name, the name of the file is no plain name, or that of another file of a checkpoint, a
            folder is a URI, or the module has an extra state that is no tensor.
        FileExistsError: If the folder has a checkpoint of the engine, or a file to replace is none that this function writes.
    """
    if cache_dir is not None:
        cache_dir = _files.local("cache_dir", cache_dir)
    folder = home_of(cache_dir) / "checkpoints" / check_name("run_name", _files.local("run_name", run_name))
    settings, stored = folder / "config.json", folder / filename
    is_plain = filename and Path(filename).name == filename and filename not in ("config.json", "manifest.json")
    if not is_plain or Path(filename).suffix == ".safetensors":
        raise ValueError(f"filename: expected a plain name for the weights, such as 'weights.pt', got {filename!r}")
    if (folder / "weights.safetensors").exists():
        raise FileExistsError(f"{folder}: it holds a checkpoint of the engine; choose another run_name")
    weights = model.state_dict()
    if others := [name for name, value in weights.items() if not torch.is_tensor(value)]:
        raise ValueError(
            f"{type(model).__name__}: {others[0]!r} of its state dict is no tensor, and load_pretrained reads tensors only; "
            "return a tensor from get_extra_state"
        )
    encoded = None if config is None else _encoded(config, config_key, folder)
    folder.mkdir(parents=True, exist_ok=True)
    # Another process may replace both files.
    with _files.locked(folder, exclusive=False):
        old = [_hash(settings.read_bytes())] if _is_own_settings(settings) else []
        is_other = encoded is not None and os.path.lexists(settings) and not old and not _has(settings, encoded)
        for file in [stored] * (os.path.lexists(stored) and _mark(stored) is None) + [settings] * is_other:
            raise FileExistsError(f"{file}: save_pretrained did not write this file; choose another run_name")
    # The old configuration as well, because a kill may come before it is replaced.
    mark: dict[str, Any] = {"config": None if encoded is None else _hash(encoded), "before": old}
    files: dict[Path, Callable[[Path], object]] = {stored: lambda beside: _save(weights, beside, mark)}
    if encoded is None:
        warnings.warn(f"{folder}: saved without a config, so load_pretrained cannot build the model", stacklevel=2)
    else:
        files[settings] = lambda beside: beside.write_bytes(encoded)
    _files.replace(files)


def _encoded(config: Any, config_key: str | None, folder: Path) -> bytes:
    """The text of a configuration to save in a folder."""
    plain = _plain(config[config_key] if config_key is not None and config_key in config else config)
    if not isinstance(plain, Mapping) or "_target_" not in plain or plain.get("_partial_"):
        problem = "saved with a config that describes no module (its _target_), so load_pretrained cannot build the model"
        warnings.warn(f"{folder}: {problem}", stacklevel=3)
    text = json.dumps(plain, indent=2)
    if len(text) > _MOST_SETTINGS:
        raise ValueError(f"config: it has {len(text)} characters, more than the {_MOST_SETTINGS} that are read again")
    return text.encode()


def _has(file: Path, content: bytes) -> bool:
    """Whether a file has this content."""
    return file.is_file() and file.stat().st_size == len(content) and file.read_bytes() == content


def _save(weights: Mapping[str, Any], file: Path, mark: Mapping[str, Any]) -> None:
    """Writes weights with a mark: the hash of their configuration as `config`, and as `before` those that it replaces."""
    torch.save(weights, file)
    with zipfile.ZipFile(file, "a") as archive:
        root = archive.namelist()[0].partition("/")[0]
        archive.writestr(zipfile.ZipInfo(f"{root}/{_MARK}"), json.dumps(mark))


def _mark(file: Path) -> dict[str, Any] | None:
    """The mark of weights; `None` if `save_pretrained` did not write the file."""
    if not file.is_file():
        return None
    try:
        with zipfile.ZipFile(file) as archive:
            entries = [entry for entry in archive.infolist() if entry.filename.partition("/")[2] == _MARK]
            # As `_save` writes it: not compressed.
            stored = [entry for entry in entries if entry.compress_type == zipfile.ZIP_STORED and entry.file_size <= 1 << 16]
            mark = json.loads(archive.read(stored[0])) if stored else None
    except (OSError, ValueError, RuntimeError, zipfile.BadZipFile):
        # It is no archive, or damaged or encrypted.
        return None
    return mark if isinstance(mark, dict) and isinstance(mark.get("before"), list) else None


def _is_own_settings(file: Path) -> bool:
    """Whether `save_pretrained` wrote a configuration and nobody has changed it: weights beside it have its hash."""
    if not file.is_file() or file.stat().st_size > _MOST_SETTINGS:
        return False
    hash = _hash(file.read_bytes())
    marks = [mark for other in file.parent.iterdir() if (mark := _mark(other)) is not None]
    return any(hash in (mark.get("config"), *mark["before"]) for mark in marks)


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _plain(config: Any) -> Any:
    """The configuration as values of JSON, with the references of OmegaConf replaced by their values."""
    if type(config).__module__.startswith("omegaconf"):
        from omegaconf import OmegaConf

        return OmegaConf.to_container(config, resolve=True)
    if isinstance(config, Mapping):
        return {str(key): _plain(value) for key, value in config.items()}
    return [_plain(value) for value in config] if isinstance(config, (list, tuple)) else config


def load_pretrained(
    name: str | os.PathLike[str],
    cache_dir: str | os.PathLike[str] | None = None,
    extra_args: Mapping[str, Any] | None = None,
    *,
    trust: bool = False,
) -> Any:
    """Loads a checkpoint as a torch module, in evaluation mode if the engine trained it.

    Files are read as data: no code of them runs. A `_target_` of a configuration that is neither a model of this package nor
    a layer of torch is refused.

    Args:
        name: A path, or a name under `$STABLEWM_HOME/checkpoints`: a run of `swm train`, a capsule, a folder with one `.pt`
            file and `config.json`, or the `.pt` file; or `zoo:` and the name of a capsule. `OWNER/NAME` also names a folder
            that the Hugging Face hub's client or `swm pull` stored as `models--OWNER--NAME`. A path that holds a
            checkpoint counts before a name, as in `swm.policy.AutoCostModel`.
        cache_dir: A folder in place of `$STABLEWM_HOME`, whose names count before paths.
        extra_args: Values of the configuration to replace, by dot key.
        trust: Whether a `_target_` may name any function, which is imported and called.

    Raises:
        FileNotFoundError: If there is no such checkpoint, or the file `config.json` is missing.
        ValueError: If the configuration is damaged, or describes no model that may be built; the error names the file.
        RuntimeError: If the weights are damaged or do not fit the model, or there is too little memory. With `trust`, errors of
            the model's construction keep their types.
    """
    path = _existing(str(name), cache_dir)
    if is_stored(path):
        if extra_args:
            raise ValueError("extra_args: the configuration of a checkpoint of the engine cannot be changed")
        # The engine checks the files: the bounds of the configuration, its hash and that of the weights, and their values.
        return module_of(Path(_engine.Model(os.path.abspath(path), "cpu", "null", False).path))
    file = path if path.is_file() else _only_weights(path)
    settings = file.parent / "config.json"
    if not settings.is_file():
        raise FileNotFoundError(f"{settings}: there is no such file, which must describe the model; expected a regular file")
    # Another process may replace both files.
    with _files.locked(file.parent, exclusive=False):
        text, weights, mark = _read_settings(settings), read_state_dict(file), _mark(file)
        config = _parsed(text, settings)
        if mark is not None and mark.get("config") != _hash(text):
            saved = "without a configuration" if mark.get("config") is None else "with another configuration"
            warnings.warn(f"{file} was saved {saved}; {settings} may describe another model", stacklevel=2)
    for key, value in (extra_args or {}).items():
        *groups, last = key.split(".")
        part = config
        for group in groups:
            part = part.setdefault(group, {})
        part[last] = value
    if trust:
        model = build(config, trust=True)
    else:
        try:
            model = _built(config, file.stat().st_size, len(weights))
        except (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
            if lacks_memory(error):
                raise
            # Torch and the modules complain of arguments in errors of many types, and know no file.
            raise ValueError(f"{settings}: {error or type(error).__name__}") from error
    if not isinstance(model, nn.Module):
        raise ValueError(f"{settings}: it describes no torch module; expected a _target_ and its arguments")
    check_numbers(weights, str(file))
    load_into(model, weights, str(file))
    return model


def _read_settings(path: Path) -> bytes:
    """The text of a configuration, which is no larger than one that a person or `save_pretrained` writes."""
    with path.open("rb") as file:
        text = file.read(_MOST_SETTINGS + 1)
    if len(text) > _MOST_SETTINGS:
        raise ValueError(f"{path}: it has more than {_MOST_SETTINGS} bytes; expected the configuration of a model")
    return text


def _parsed(text: bytes, path: Path) -> Any:
    """The configuration that a file has as JSON."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: it is no JSON ({error}); expected the configuration of a model") from error


def _built(config: Any, stored_bytes: int, stored_tensors: int) -> Any:
    """The model of a configuration that is not trusted, of the size of its weights."""
    if _modules(config) > stored_tensors + _FREE_MODULES:
        raise ValueError(
            f"the configuration describes {_modules(config)} modules, and the weights have {stored_tensors} tensors; "
            "pass trust=True if you trust the files"
        )
    if (largest := _largest(config)) > max(_LARGEST, stored_bytes):
        raise ValueError(
            f"the configuration has the number {largest}, and the file of the weights {stored_bytes} bytes; "
            "pass trust=True if you trust the files"
        )
    # Without memory first: a large model is refused before it takes any.
    with bounded(stored_bytes, stored_tensors), torch.device("meta"):
        build(config)
    with bounded(stored_bytes, stored_tensors):
        model = build(config)
    if isinstance(model, nn.Module) and any(value.is_meta for value in [*model.parameters(), *model.buffers()]):
        raise ValueError("the configuration places weights on the device 'meta', which has no memory for them")
    return model


def _modules(config: Any) -> int:
    """The number of modules that a configuration names."""
    if isinstance(config, Mapping):
        return ("_target_" in config) + sum(_modules(value) for value in config.values())
    return sum(_modules(value) for value in config) if isinstance(config, list) else 0


def _largest(config: Any) -> int:
    """The largest integer in a configuration."""
    if isinstance(config, (Mapping, list)):
        return max((_largest(value) for value in (config.values() if isinstance(config, Mapping) else config)), default=0)
    return config if isinstance(config, int) else 0


def _existing(name: str, cache_dir: str | os.PathLike[str] | None) -> Path:
    """The file or folder of a checkpoint."""
    if name.startswith("zoo:"):
        return Path(_engine.Model(name, "cpu", "null", False).path)
    path = located(name, cache_dir)
    if path is None:
        folder = home_of(cache_dir) / "checkpoints"
        raise FileNotFoundError(
            f"there is no checkpoint {name!r}: neither a path nor a name under {folder}; `swm pull` downloads one"
        )
    return path


def _only_weights(folder: Path) -> Path:
    files = sorted(file for file in folder.glob("*.pt") if file.is_file())
    if not files:
        raise FileNotFoundError(f"{folder}: it has no .pt file; if a checkpoint elsewhere has this name, give its whole path")
    if len(files) > 1:
        raise ValueError(f"{folder}: it has several .pt files; name one: {', '.join(file.name for file in files)}")
    return files[0]
