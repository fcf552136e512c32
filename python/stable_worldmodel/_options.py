"""Converts the options of resets and evaluations to the JSON of the engine."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

KNOWN = ("variation", "variation_values", "state", "goal_state")


def count(name: str, value: Any, least: int = 1) -> int:
    """The value as a count of at least `least`.

    Raises:
        ValueError: When it is no whole number, or is out of range. The engine's counts have 63 bits.
    """
    try:
        whole = not isinstance(value, (bool, np.bool_)) and int(value) == value
        fits = whole and least <= int(value) < 1 << 63
    except (TypeError, ValueError, OverflowError):
        whole = fits = False
    if not fits:
        bound = " and below 2^63" if whole and int(value) >= 1 << 63 else ""
        raise ValueError(f"{name}: {value!r}; expected a whole number of at least {least}{bound}")
    return int(value)


def whole(name: str, value: Any) -> int:
    """The value as an integer.

    Raises:
        ValueError: When it is no whole number.
    """
    try:
        fits = not isinstance(value, (bool, np.bool_)) and int(value) == value
    except (TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise ValueError(f"{name}: {value!r}; expected a whole number")
    return int(value)


def finite(name: str, value: Any) -> float:
    """The value as a finite number that is not negative.

    Raises:
        ValueError: When it is none.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and number >= 0):
        raise ValueError(f"{name}: {value!r}; expected a finite number of at least 0")
    return number


def valid_text(name: str, value: str) -> str:
    """The text, if UTF-8 can hold it.

    Raises:
        ValueError: If it has half of a surrogate pair.
    """
    try:
        value.encode()
    except UnicodeEncodeError as error:
        near = value[max(0, error.start - 20) : error.end + 20]
        raise ValueError(
            f"{name}: {near!r} has half of a surrogate pair, which UTF-8 cannot hold; give a text without it"
        ) from None
    return value


def as_json(name: str, value: Any) -> str:
    """A value as JSON for the engine.

    Raises:
        ValueError: If a text has half of a surrogate pair.
    """
    text = json.dumps(value)
    if "\\ud" in text:
        valid_text(name, json.dumps(value, ensure_ascii=False))
    return text


def indices(name: str, given: Any, count: int) -> list[int]:
    """The indices in a sequence of whole numbers, or where a mask of `count` booleans is true.

    Raises:
        TypeError: When the values are neither.
        ValueError: When a mask has another length, or an index is negative.
    """
    array = np.asarray(given)
    if array.dtype == bool:
        if array.shape != (count,):
            raise ValueError(f"{name}: expected a mask of {count} booleans, got the shape {array.shape}")
        array = np.flatnonzero(array)
        return [int(index) for index in array]
    if array.size == 0:
        return []
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise TypeError(f"{name}: expected indices or a mask of booleans, got {given!r}")
    if array.min() < 0:
        raise ValueError(f"{name}: {array.min()}; expected indices from 0 to {count - 1}")
    return [int(index) for index in array]


def starts(episodes: Any, steps: Any) -> list[list[int]]:
    """The pairs of an episode and a step from which evaluations start.

    Raises:
        ValueError: When the sequences have other lengths, or values that are no whole numbers of at least 0.
    """
    found = []
    for name, given in (("episodes_idx", episodes), ("start_steps", steps)):
        try:
            values = np.asarray(given)
        except ValueError:
            values = np.asarray(None)
        whole = values.ndim == 1 and values.dtype.kind in "iuf" and bool(np.all((values >= 0) & (values == np.round(values))))
        if not whole or np.any(values >= 1 << 62):
            raise ValueError(f"{name}: {given!r}; expected a sequence of whole numbers of at least 0")
        found.append([int(value) for value in values])
    if len(found[0]) != len(found[1]):
        raise ValueError(
            f"episodes_idx, start_steps: they have {len(found[0])} and {len(found[1])} values; give a step for each episode"
        )
    if not found[0]:
        raise ValueError("episodes_idx, start_steps: they are empty; give at least one start, or neither")
    return [list(pair) for pair in zip(*found, strict=True)]


def variation(options: Mapping[str, Any] | None, spaces: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The variation request in `options`.

    Args:
        options: The options of a reset. A colour of floats that are all from 0 to 1 has fractions, so `[1.0, 0.0, 0.0]` is
            red; other colours have values from 0 to 255, so `[1, 0, 0]` is almost black.
        spaces: The descriptions of the environment's factors, by key.

    Returns:
        The factors to sample (`variation`) and the values of pinned factors (`variation_values`).
    """
    options = options or {}
    unknown = [name for name in options if name not in KNOWN]
    if unknown:
        raise ValueError(f"options: unknown {unknown}; the options are {list(KNOWN)}")
    sampled = options.get("variation")
    if isinstance(sampled, str):
        sampled = [sampled]
    if sampled is not None and not (
        isinstance(sampled, (Sequence, set, frozenset)) and all(isinstance(key, str) for key in sampled)
    ):
        raise ValueError(f"options['variation']: expected names of factors, such as ['agent.color'], got {sampled!r}")
    values = options.get("variation_values") or {}
    if not isinstance(values, Mapping):
        raise ValueError(f"options['variation_values']: expected a dict from factors to values, got {values!r}")
    values = {_known(key, spaces): value for key, value in values.items()}
    pinned = {key: _floats(key, value, spaces.get(key)) for key, value in values.items()}
    sampled = None if sampled is None else sorted({_known(key, spaces) for key in sampled})
    return {"variation": sampled, "variation_values": pinned}


def reset(options: Mapping[str, Any] | None, spaces: Mapping[str, Mapping[str, Any]]) -> str:
    """All options of a reset, as JSON."""
    options = {} if options is None else options
    if not isinstance(options, Mapping):
        raise TypeError(f"options: expected a dict such as {{'variation': ['all']}}, or None, got {options!r}")
    given = {
        name: None if options.get(name) is None else _numbers(f"options[{name!r}]", options[name]).tolist()
        for name in ("state", "goal_state")
    }
    return json.dumps({"variation": variation(options, spaces), **given})


def setting(value: Any, name: str = "a setting") -> str:
    """The value of a setting as the command line reads it: TOML, in which a text on its own is bare.

    Raises:
        TypeError: When the value is `None` or contains it, because TOML has no such value; `name` says where.
    """
    return value if isinstance(value, str) else _toml(value, name)


def _toml(value: Any, name: str) -> str:
    if isinstance(value, np.ndarray):
        value = list(value) if value.ndim else value[()]
    if isinstance(value, np.floating):
        # The shortest text for its type: float32 of 0.0003 is 0.0003000000142492354 as a float of Python.
        return str(value)
    # Other scalars of numpy, and tensors.
    value = value.tolist() if hasattr(value, "tolist") else value
    if value is None:
        raise TypeError(f"{name}: None; expected a value; leave the setting out for its default")
    if isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, Mapping):
        items = ((_quoted(str(key)), _toml(item, f"{name}.{key}")) for key, item in value.items())
        return "{" + ", ".join(f"{key} = {text}" for key, text in items) + "}"
    if isinstance(value, (list, tuple, range)):
        return "[" + ", ".join(_toml(item, name) for item in value) + "]"
    return _quoted(value) if isinstance(value, str) else str(value)


def _quoted(text: str) -> str:
    # JSON writes characters such as emoji as two surrogates otherwise, which TOML does not have.
    return json.dumps(text, ensure_ascii=False)


def callables(given: Any) -> list[dict[str, Any]]:
    """The `callables` of `World.evaluate`, checked and converted to values that JSON can hold."""
    calls = []
    for call in given or ():
        method, args = (call.get("method"), call.get("args") or {}) if isinstance(call, Mapping) else (None, {})
        if not isinstance(method, str) or not isinstance(args, Mapping):
            raise ValueError(f"callables: expected {{'method': NAME, 'args': {{KEYWORD: {{'value': COLUMN}}}}}}, got {call!r}")
        arguments: dict[str, Any] = {}
        for key, argument in args.items():
            if not isinstance(argument, Mapping) or "value" not in argument:
                raise ValueError(f"callables: {method}({key}=…) needs {{'value': COLUMN}}, got {argument!r}")
            in_dataset, value = bool(argument.get("in_dataset", True)), argument["value"]
            if in_dataset and not isinstance(value, str):
                raise ValueError(
                    f"callables: {method}({key}=…) has the column {value!r}; give a name, or 'in_dataset': False for a value"
                )
            arguments[str(key)] = {"value": _plain(value, f"{method}({key}=…)"), "in_dataset": in_dataset}
        calls.append({"method": method, "args": arguments})
    return calls


def _plain(value: Any, what: str) -> Any:
    """The value in a form that JSON can hold: arrays become their type, shape and bytes."""
    if hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    if isinstance(value, (np.ndarray, np.generic)) and value.dtype.kind in "biuf":
        return {"dtype": value.dtype.name, "shape": list(value.shape), "data": value.tobytes().hex()}
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise TypeError(f"callables: {what} is {value!r}; expected a number, text, list, dict or numeric array") from error
    return value


def _known(key: str, spaces: Mapping[str, Any]) -> str:
    """Returns the environment's key of a factor. The paper's listings write `agent.size` for `agent.scale` of Push-T."""
    group, _, name = key.rpartition(".")
    scale = f"{group}.scale"
    return scale if name == "size" and key not in spaces and scale in spaces else key


def _numbers(name: str, value: Any) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The value as finite numbers, in one dimension."""
    try:
        values = np.asarray(value, dtype=np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers, got {value!r}") from error
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name}: expected finite numbers, got {value!r}")
    return values


def are_fractions(colour: Any) -> bool:
    """Whether the values of a colour are fractions of 255: floats that are all from 0 to 1."""
    values = np.asarray(colour)
    return values.dtype.kind == "f" and bool(np.all((values >= 0) & (values <= 1)))


def _floats(key: str, value: Any, space: Mapping[str, Any] | None) -> list[float]:
    values = _numbers(f"options['variation_values'][{key!r}]", value)
    if space is not None and space["type"] == "RGBBox" and are_fractions(value):
        values = np.round(255 * values)
    found: list[float] = values.tolist()
    return found
