"""Descriptions of settings for manifests: equal settings have equal descriptions in every process.

A setting of which there is no such description, such as an open file, raises `Unrecorded`.
"""

from __future__ import annotations

import dis
import functools
import hashlib
import io
import itertools
import json
import math
import os
import random
import re
import types
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Space

from .. import _torch

__all__ = ["Unrecorded", "described", "flat", "is_of_package", "modules_hash", "named", "qualified", "short"]

#: The largest array that is recorded by its elements instead of their hash.
_SMALL = 8

#: The most parts of a setting. Those that have more are not recorded.
_MOST_PARTS = 10_000

#: The most objects that are searched for torch modules, and the most entries of one container: the other transitions of a
#: buffer are like its first ones.
_MOST_OBJECTS = 20_000
_MOST_ENTRIES = 1_000

#: The longest text of a setting in the name of a policy or the record of a wrapper; longer ones are recorded by their hash.
_LONGEST = 200

#: The most settings with names of their own in the record of a wrapper; a larger dict is recorded by its hash.
_MOST_NAMES = 64

#: How deeply settings may be nested. Deeper ones, such as those that contain themselves, are not recorded.
_DEPTH = 12


class Unrecorded(ValueError):
    """A setting that cannot be recorded."""


def described(value: Any, depth: int = _DEPTH, parts: Iterator[int] | None = None) -> Any:
    """A setting as JSON can hold it; equal settings have equal descriptions in every process.

    Args:
        value: The setting.
        depth: How deeply it may be nested.
        parts: Counts the parts of the setting that `value` is a part of; `None` if it is a part of none.

    Raises:
        Unrecorded: When the setting has no such description.
    """
    parts = itertools.count(1) if parts is None else parts
    if next(parts) > _MOST_PARTS:
        raise Unrecorded(f"it has more than {_MOST_PARTS} parts")
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, (int, float)):
        return value if isinstance(value, int) or math.isfinite(value) else str(value)
    if isinstance(value, (bytes, bytearray)):
        return {"bytes": _array(np.frombuffer(value, np.uint8), list)}
    if not depth:
        raise Unrecorded("it is nested too deeply")
    inner = functools.partial(described, depth=depth - 1, parts=parts)
    if isinstance(value, np.ndarray) or _is_tensor(value):
        return _array(value, inner)
    if isinstance(value, Mapping):
        items = [(key if isinstance(key, (str, int, float)) else _text(inner(key)), inner(one)) for key, one in value.items()]
        found = {str(key): one for key, one in items}
        if len(found) < len(items):
            raise Unrecorded("it has keys of equal texts")
        return found
    if isinstance(value, (list, tuple)):
        return [inner(one) for one in value]
    if isinstance(value, (set, frozenset)):
        return sorted((inner(one) for one in value), key=_text)
    if isinstance(value, functools.partial):
        return {"function": inner(value.func), "args": inner(value.args), "named": inner(value.keywords)}
    owner = getattr(value, "__self__", None)
    if isinstance(value, (types.MethodType, types.BuiltinMethodType)) and not isinstance(owner, (types.ModuleType, type)):
        return {"method": value.__name__, "of": inner(owner)}
    if isinstance(value, types.FunctionType):
        return _function(value, inner)
    if isinstance(value, (type, np.ufunc)) or (callable(value) and "<" not in getattr(value, "__qualname__", "<")):
        return qualified(value)
    return _object(value, inner)


def _array(value: Any, inner: Callable[[Any], Any]) -> Any:
    if _is_tensor(value):
        value = value.detach().cpu()
        value = (value.float() if str(value.dtype) == "torch.bfloat16" else value).numpy()
    if value.dtype == object:
        return inner(value.tolist())
    if value.size <= _SMALL:
        return inner(value.tolist())
    digest = hashlib.sha256(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data).hexdigest()
    return {"dtype": str(value.dtype), "shape": list(value.shape), "sha256": digest}


def _is_tensor(value: Any) -> bool:
    torch = _torch.loaded()
    return torch is not None and bool(torch.is_tensor(value))


def _function(function: types.FunctionType, inner: Callable[[Any], Any]) -> dict[str, Any]:
    """A function by its name, its code, the values that it holds, and the plain values that it reads from its module."""
    defaults = [*(function.__defaults__ or ()), *sorted((function.__kwdefaults__ or {}).items())]
    module = function.__globals__
    read = {name: module[name] for name in sorted(_read(function.__code__)) if name in module and _is_plain(module[name])}
    found = {"function": qualified(function), "code": _code(function.__code__)}
    parts = (("holds", _held(function)), ("defaults", defaults), ("globals", read))
    return found | {key: inner(one) for key, one in parts if one}


def _held(function: types.FunctionType) -> dict[str, Any]:
    """The values of the enclosing scopes that a function holds, by name."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    # A function may hold a name that has no value yet, whose cell is equal to an empty one.
    return {name: cell.cell_contents for name, cell in cells if cell != types.CellType()}


def _read(code: types.CodeType) -> set[str]:
    """The globals that code reads, also in functions that it defines; without those such as `__file__`."""
    found = {step.argval for step in dis.get_instructions(code) if step.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    inner = (constant for constant in code.co_consts if isinstance(constant, types.CodeType))
    return {name for name in found if name[:2] != "__"}.union(*map(_read, inner))


def _is_plain(value: Any) -> bool:
    """Whether this is a number, a text, or a tuple of these."""
    if isinstance(value, tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, (bool, int, float, str, bytes, np.generic))


def _code(code: types.CodeType) -> str:
    """A hash of compiled code, which does not depend on the lines of its file."""

    def constant(value: Any) -> str:
        if isinstance(value, types.CodeType):
            return _code(value)
        # The order of a set of texts differs between processes.
        return repr(sorted(map(repr, value))) if isinstance(value, frozenset) else repr(value)

    parts = [code.co_code.hex(), repr(code.co_names), *map(constant, code.co_consts)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def _object(value: Any, inner: Callable[[Any], Any]) -> Any:
    """An object by its class and its attributes, or by its `repr` if that has no address in memory."""
    torch = _torch.loaded()
    # Open files and sockets have a number of this process; the state of a generator is not in its attributes.
    if isinstance(value, (io.IOBase, random.Random)) or hasattr(type(value), "fileno"):
        raise Unrecorded(f"{type(value).__name__} has a state that is not equal in another process")
    if isinstance(value, os.PathLike):
        return inner(os.fspath(value))
    if torch is not None and isinstance(value, torch.nn.Module):
        own = set(vars(torch.nn.Module()))
        parts = [_settings(part, own, inner) for part in value.modules()]
        # The functions in a module's text have their addresses there, and are among its parts.
        text = re.sub(r" at 0x[0-9a-fA-F]+", "", repr(value))
        return {"class": qualified(type(value)), "parts": parts, "weights": modules_hash(value), "repr": text}
    attributes: Any = getattr(value, "__dict__", None)
    if attributes and not isinstance(value, types.ModuleType):
        # Spaces make their generator when they are first sampled.
        hidden = {"_np_random"} if isinstance(value, Space) else set()
        return {"class": qualified(type(value)), **{name: inner(one) for name, one in attributes.items() if name not in hidden}}
    text = repr(value)
    if re.search(r"\bat 0x[0-9a-fA-F]+", text):
        raise Unrecorded(f"{type(value).__name__} has no text that is equal in another process")
    return {"class": qualified(type(value)), "repr": text} if text else qualified(type(value))


def _settings(module: Any, own: set[str], inner: Callable[[Any], Any]) -> dict[str, Any]:
    """The attributes of a torch module without those of every module. Private ones that have no description are left out."""
    found = {}
    for name, value in vars(module).items():
        if name not in own:
            try:
                found[name] = inner(value)
            except Unrecorded:
                if name[0] != "_":
                    raise
    return found


def named(name: str, value: Any) -> Any:
    """The description of a setting; its error names it."""
    try:
        return described(value)
    except Unrecorded as error:
        raise Unrecorded(f"{name} ({error})") from error
    except Exception as error:
        raise Unrecorded(f"{name} ({type(error).__name__}: {error!s:.100})") from error


def flat(settings: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """The settings as pairs of a key such as `plan.horizon` and a text, in the order of the keys."""
    for key, value in sorted(settings.items()):
        if isinstance(value, Mapping) and value:
            yield from flat(value, f"{before}{key}.")
        else:
            value = _short(value)
            yield f"{before}{key}", value if isinstance(value, str) else _text(value)


def short(settings: Any) -> Any:
    """The settings with long ones as their hashes."""
    if isinstance(settings, Mapping) and len(settings) <= _MOST_NAMES:
        return {key: short(value) for key, value in settings.items()}
    return _short(settings)


def _short(value: Any) -> Any:
    """A description, or its hash if it is long."""
    text = value if isinstance(value, str) else _text(value)
    return f"sha256-{hashlib.sha256(text.encode()).hexdigest()}" if len(text) > _LONGEST else value


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", "="), default=str)


def qualified(given: Any) -> str:
    """The name of a class or a function with its module."""
    name = getattr(given, "__qualname__", None) or getattr(given, "__name__", type(given).__name__)
    return f"{getattr(given, '__module__', None) or type(given).__module__}.{name}"


def is_of_package(made: Any) -> bool:
    return str(getattr(made, "__module__", "")).split(".")[0] == "stable_worldmodel"


def modules_hash(given: Any) -> str | None:
    """The hash of the weights of the torch modules that an object is or holds; `None` if there are none.

    It is of the names, shapes, types and bytes of their state dicts, and begins with `torch-sha256-`, so that it is never taken
    for the engine's hash of a file.

    Raises:
        Unrecorded: When the weights cannot be read.
    """
    torch = _torch.loaded()
    modules = [] if torch is None else list(_modules(given, torch))
    if not modules:
        return None
    digest = hashlib.sha256()
    for name, module in modules:
        digest.update(f"{name}\n".encode())
        _hash_module(module, digest, torch)
    return f"torch-sha256-{digest.hexdigest()}"


def _hash_module(module: Any, digest: Any, torch: Any) -> None:
    """Adds the state dict of a module to a hash."""
    try:
        for name, value in sorted(module.state_dict().items()):
            if not torch.is_tensor(value):
                digest.update(f"{name}\n{_text(described(value))}\n".encode())
                continue
            value = value.detach()
            value = (value.to_dense() if value.layout != torch.strided else value).cpu().contiguous()
            digest.update(f"{name}\n{value.dtype}\n{tuple(value.shape)}\n".encode())
            digest.update(memoryview(value.reshape(-1).view(torch.uint8).numpy()))
    except Exception as error:
        raise Unrecorded(f"the weights of {type(module).__name__} ({error!s:.100})") from error


def _modules(given: Any, torch: Any) -> Iterator[tuple[str, Any]]:
    """The torch modules that an object is or holds, each with the names of the attributes and the keys that lead to it.

    Raises:
        Unrecorded: When a set holds one, because sets have no order, or there are too many objects to search.
    """
    leaves = (type, types.ModuleType, str, bytes, int, float, complex, type(None), np.generic, torch.Tensor)
    # The objects themselves, so that the id of a temporary one is not used twice.
    seen: dict[int, Any] = {}
    waiting = [*_of_classes(given, torch), ("", given)]
    while waiting:
        name, one = waiting.pop()
        # A `World` has a policy of its own.
        is_world = str(type(one).__module__).startswith("stable_worldmodel.world")
        if id(one) in seen or is_world or isinstance(one, leaves):
            continue
        seen[id(one)] = one
        if isinstance(one, torch.nn.Module):
            if f".{_OF_SET}" in name:
                raise Unrecorded("a set holds torch modules, which have no order there; use a list")
            yield name, one
            continue
        parts = [(f"{name}.{key}", part) for key, part in _parts(one) if not isinstance(part, leaves) and not _is_data(part)]
        waiting += reversed(parts)
        if len(seen) + len(waiting) > _MOST_OBJECTS:
            raise Unrecorded(f"more than {_MOST_OBJECTS} objects to search for torch modules")


def _of_classes(given: Any, torch: Any) -> Iterator[tuple[str, Any]]:
    """The torch modules among the attributes of an object's classes, and the methods of these, which may hold others."""
    for base in type(given).__mro__:
        if str(base.__module__).split(".")[0] not in _KNOWN:
            for name, value in sorted(vars(base).items()):
                if isinstance(value, (types.FunctionType, torch.nn.Module)):
                    yield f".{base.__qualname__}.{name}", value


#: The packages whose classes hold no torch modules of a user.
_KNOWN = {"abc", "builtins", "collections", "gymnasium", "stable_worldmodel", "torch", "typing"}


def _is_data(given: Any) -> bool:
    return isinstance(given, np.ndarray) and given.dtype != object


#: The key of all parts of sets.
_OF_SET = "{}"


def _parts(given: Any) -> Iterator[tuple[Any, Any]]:
    """The objects that an object holds, with the names of its attributes, or their keys."""
    if isinstance(given, types.FunctionType):
        yield from enumerate([*_held(given).values(), *(given.__defaults__ or ()), *(given.__kwdefaults__ or {}).values()])
    elif isinstance(given, functools.partial):
        yield from enumerate([given.func, given.args, given.keywords])
    elif isinstance(given, (types.MethodType, types.BuiltinMethodType)):
        yield from enumerate([given.__self__, getattr(given, "__func__", None)])
    elif isinstance(given, (dict, types.MappingProxyType)):
        # The texts of other keys may be long, or have an address in memory.
        are_texts = all(isinstance(key, str) for key in given)
        entries = ((key, given[key]) for key in sorted(given)) if are_texts else enumerate(given.values())
        yield from itertools.islice(entries, _MOST_ENTRIES)
    elif isinstance(given, (list, tuple, deque)):
        yield from itertools.islice(enumerate(given), _MOST_ENTRIES)
    elif isinstance(given, (set, frozenset)):
        yield from ((_OF_SET, one) for one in given)
    elif isinstance(given, np.ndarray):
        yield from enumerate(given.ravel() if given.dtype == object else ())
    slots = (vars(base) for base in type(given).__mro__ if "__slots__" in vars(base))
    held = [(name, slot) for names in slots for name, slot in names.items() if isinstance(slot, types.MemberDescriptorType)]
    for name, slot in held:
        try:
            yield name, slot.__get__(given)
        except AttributeError:
            # It has no value yet.
            continue
    attributes = getattr(given, "__dict__", None) or {}
    yield from ((name, attributes[name]) for name in sorted(attributes))
