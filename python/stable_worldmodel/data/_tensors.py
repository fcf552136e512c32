"""Conversion between arrays, tensors and episodes of rows."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt

from stable_worldmodel import _options, _torch

Array = npt.NDArray[Any]
Backend = Literal["torch", "numpy"]

#: The columns with the indices of episodes and steps. Readers compute them, writers ignore them.
NUMBERING = ("episode_idx", "step_idx")

#: The key of an episode's own values, which datasets store as a constant of the episode.
EPISODE = "episode_data"

#: The type in which values are stored, for each type that datasets do not support.
_WIDER = {
    "float16": "float32",
    "int8": "int32",
    "int16": "int32",
    "uint16": "int32",
    "uint32": "int64",
    "uint64": "int64",
}
_STORED = ("bool", "uint8", "int32", "int64", "float32", "float64")


def backend(given: str | None) -> Backend:
    """The backend of samples: the given one, else torch if it is installed."""
    if given is None:
        return "torch" if importlib.util.find_spec("torch") is not None else "numpy"
    if given not in ("torch", "numpy"):
        raise ValueError(f"backend: expected 'torch' or 'numpy', got {given!r}")
    return cast(Backend, given)


def has_gpu() -> bool:
    """Whether torch has a GPU, for page-locked memory."""
    import torch

    return torch.cuda.is_available()


def wrap(array: Array, kind: Backend) -> Any:
    """The array, or a tensor that shares its memory."""
    if kind == "numpy":
        return array
    import torch

    return torch.from_numpy(array)


def is_image(shape: tuple[int, ...]) -> bool:
    """Whether rows of this shape are images, `(H, W, 1)` or `(H, W, 3)`."""
    return len(shape) == 3 and shape[-1] in (1, 3)


def channels_first(array: Array, shape: tuple[int, ...]) -> Array:
    """Images `(..., H, W, C)` as a view `(..., C, H, W)`; other arrays unchanged. `shape` is the shape of a row."""
    return np.moveaxis(array, -1, -3) if is_image(shape) else array


def to_numpy(value: Any) -> Array:
    """A tensor, a list of tensors, or any array-like value as an array."""
    torch = _torch.loaded()
    if torch is not None:
        if isinstance(value, torch.Tensor):
            return _from_torch(value)
        if isinstance(value, (list, tuple)) and value and isinstance(value[0], torch.Tensor):
            return np.stack([_from_torch(item) for item in value])
    return np.asarray(value)


def _from_torch(tensor: Any) -> Array:
    tensor = tensor.detach().cpu()
    if str(tensor.dtype) == "torch.bfloat16":
        tensor = tensor.float()
    return cast(Array, tensor.numpy())


def _check_numbering(name: str, value: Any) -> None:
    """Refuses a column that has a name of `NUMBERING` and holds something else."""
    try:
        numbers = np.asarray(to_numpy(value), dtype=np.float64)
        # Some sources store scalar columns as lists of one element.
        scalar = numbers.ndim == 0 or numbers.size == len(numbers)
        integers = np.all(numbers == np.round(numbers))
        fits = bool(scalar and integers and np.all(np.diff(numbers.reshape(-1)) == (1 if name == "step_idx" else 0)))
    except (TypeError, ValueError):
        fits = False
    if not fits:
        expected = "the numbers of consecutive steps" if name == "step_idx" else "one number, the same for each step"
        raise ValueError(
            f"column {name!r}: its values would be lost, because datasets number episodes and steps themselves;"
            f" rename the column, or give {expected}"
        )


def rows(episode: Mapping[str, Any]) -> tuple[dict[str, Array], dict[str, str | bytes]]:
    """Splits an episode into arrays `(T, ...)` of types that can be stored, and text constants.

    `episode_idx` and `step_idx` are left out, because datasets number episodes and steps from 0; other values of these names
    than one number, and those of consecutive steps, are errors.

    Images `(T, C, H, W)` become `(T, H, W, C)`. Text is stored once per episode. `action` may have one row fewer than
    the other columns, because no action follows the final observation.
    """
    arrays: dict[str, Array] = {}
    constants: dict[str, str | bytes] = {}
    for name, value in episode.items():
        if name in NUMBERING:
            _check_numbering(name, value)
            continue
        if name == EPISODE:
            if value:
                constants[name] = json.dumps({key: _described(key, item) for key, item in dict(value).items()})
            continue
        text = _text(name, value)
        if text is not None:
            constants[name] = _options.valid_text(f"column {name!r}", text) if isinstance(text, str) else text
            continue
        if np.ma.is_masked(value):
            raise ValueError(f"column {name!r}: it has masked values, which datasets cannot leave out; fill them with `filled`")
        try:
            array = to_numpy(value)
        except ValueError as error:
            raise ValueError(f"column {name!r}: its steps differ in shape: {error}") from error
        if array.ndim == 0:
            raise ValueError(f"column {name!r}: expected one value for each step, got {value!r}")
        dtype = _WIDER.get(array.dtype.name, array.dtype.name)
        if dtype not in _STORED:
            raise TypeError(
                f"column {name!r}: {array.dtype} cannot be stored; expected numeric values, or one text per episode"
            )
        channels_lead = array.ndim == 4 and array.shape[1] in (1, 3) and array.shape[-1] not in (1, 3)
        if channels_lead and array.dtype == np.uint8:
            array = np.moveaxis(array, 1, -1)
        arrays[name] = exact(f"column {name!r}", array, dtype)
    _equal_lengths(arrays)
    return arrays, constants


def whole(what: str, given: Any) -> Array:
    """Indices as an array of 64-bit integers.

    Raises:
        TypeError: When the values are no whole numbers, such as those of a mask.
        IndexError: When a value is larger than any index.
    """
    array = np.asarray(given)
    if array.size and array.dtype.kind not in "iu":
        raise TypeError(f"{what}: expected whole numbers, got {array.dtype}; np.flatnonzero gives the indices of a mask")
    if array.size and array.max() > np.iinfo(np.int64).max:
        raise IndexError(f"{what}: {array.max()} is larger than any index")
    return array.astype(np.int64)


def exact(what: str, array: Array, dtype: str) -> Array:
    """The array, contiguous and in another type. Integers keep their values, and finite numbers stay finite.

    Raises:
        ValueError: When the type cannot hold a value.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        converted = np.ascontiguousarray(array, dtype=dtype)
    if array.dtype == converted.dtype or array.size == 0:
        return converted
    if array.dtype.kind in "iu":
        with np.errstate(invalid="ignore"):
            wrong = converted.astype(array.dtype) != array
        if converted.dtype.kind == "i" and array.dtype.kind == "u":
            wrong |= converted < 0
        if converted.dtype.kind == "u" and array.dtype.kind == "i":
            wrong |= array < 0
    else:
        wrong = np.isfinite(array) & ~np.isfinite(converted)
    if wrong.any():
        value = array[wrong].ravel()[0]
        raise ValueError(f"{what}: {value} is stored as {dtype}, which cannot hold it; scale it or leave the column out")
    return converted


def _described(name: str, value: Any) -> Any:
    """A value of an episode in a form that JSON can hold: text, or an array with its type."""
    if isinstance(value, str):
        return value
    array = to_numpy(value)
    if array.dtype.kind not in "biuf":
        raise TypeError(f"{EPISODE}[{name!r}]: {array.dtype} cannot be stored; expected numbers or text")
    return {"dtype": array.dtype.name, "values": array.tolist()}


def episode_values(text: bytes | None) -> dict[str, Any]:
    """The values of an episode that `rows` stored; empty if it has none."""
    if text is None:
        return {}
    stored = json.loads(text)
    if not isinstance(stored, dict):
        raise ValueError(f"{EPISODE}: expected an object of JSON, got {type(stored).__name__}")
    return {key: item if isinstance(item, str) else _numbers(key, item) for key, item in stored.items()}


#: The types of an episode's own values.
_NUMERIC = frozenset("bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float16 float32 float64".split())


def _numbers(name: str, item: Any) -> Array:
    """The array that `_described` stored. A third-party file can state any type and any values."""
    dtype, values = (item.get("dtype"), item.get("values")) if isinstance(item, dict) else (None, None)
    if not isinstance(dtype, str) or dtype not in _NUMERIC:
        raise ValueError(f"{EPISODE}[{name!r}]: expected text, or values of a numeric type, got the type {str(dtype)[:40]!r}")
    try:
        given = np.asarray(values)
        with np.errstate(over="ignore", invalid="ignore"):
            array = given.astype(dtype)
        fits = given.dtype.kind in "biuf" and np.array_equal(array, given, equal_nan=given.dtype.kind == "f")
    except (TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise ValueError(f"{EPISODE}[{name!r}]: its values are not of its type {dtype}")
    return array


def episode_table(episodes: Sequence[Mapping[str, Any]]) -> dict[str, Array]:
    """The values of several episodes, `(episodes, ..)`: those that all of them have."""
    if not episodes:
        return {}
    shared = [name for name in episodes[0] if all(name in episode for episode in episodes)]
    return {name: _stacked([episode[name] for episode in episodes]) for name in shared}


#: The most characters of texts that are padded to the longest.
_MOST_CHARACTERS = 1 << 24


def _stacked(values: list[Any]) -> Array:
    """The values along a new first axis. Long texts are objects: numpy would pad each to the longest."""
    if all(isinstance(value, str) for value in values) and len(values) * max(map(len, values)) > _MOST_CHARACTERS:
        return np.array(values, dtype=object)
    return np.stack([np.asarray(value) for value in values])


def _text(name: str, value: Any) -> str | bytes | None:
    """The text of a column, which is the same in every step; `None` for numeric columns."""
    if isinstance(value, (str, bytes)):
        return value
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "SUO":
            return None
        value = value.ravel().tolist()
    if isinstance(value, (list, tuple)) and value and isinstance(value[0], (str, bytes)):
        if any(step != value[0] for step in value):
            raise TypeError(f"column {name!r}: text that changes within an episode cannot be stored")
        return value[0]
    return None


def _equal_lengths(arrays: dict[str, Array]) -> None:
    longest = max((len(array) for array in arrays.values()), default=0)
    action = arrays.get("action")
    if action is not None and len(action) == longest - 1:
        if action.dtype.kind not in _MISSING:
            raise ValueError(
                f"column 'action': got {len(action)} actions of {longest} steps, so the last is missing, but {action.dtype} "
                "has no value for a missing action; convert the actions to int32"
            )
        missing = np.full((1, *action.shape[1:]), _MISSING[action.dtype.kind], dtype=action.dtype)
        arrays["action"] = np.concatenate([action, missing])
    lengths = {name: len(array) for name, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the columns of an episode must have the same number of steps, got {lengths}")


def without_last_action(arrays: dict[str, Array]) -> bool:
    """Marks the action of the last row as missing, because no observation follows it; returns whether there was one."""
    action = arrays.get("action")
    if action is None or not len(action) or action.dtype.kind not in _MISSING:
        return False
    known = ~np.isnan(action[-1]) if action.dtype.kind == "f" else action[-1] != -1
    if not known.any():
        return False
    arrays["action"] = action = action.copy()
    action[-1] = _MISSING[action.dtype.kind]
    return True


def keeps_last_action(arrays: dict[str, Array]) -> bool:
    """Whether the action of the last row stays, because its type has no value for a missing action."""
    action = arrays.get("action")
    return action is not None and len(action) > 0 and action.dtype.kind not in _MISSING


#: What a writer warns of, once, when an episode has an action in its last row: it is left out, or stays.
LAST_ACTION = "the action of an episode's last row is left out, because no observation follows it"
LAST_ACTION_STAYS = "the action of an episode's last row is stored, because uint8 and bool have no value for a missing action"

#: The value of a missing action, by the kind of its type. Other kinds have none.
_MISSING = {"f": np.nan, "i": -1}
