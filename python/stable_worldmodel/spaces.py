"""Gymnasium's spaces with a value, a default and a condition: the spaces of factors of variation.

A factor is a space with an `init_value` (its default), a current `value`, and optionally a `constrain_fn` that samples
must satisfy. A nested `Dict` of factors is a `variation_space`; a factor's key joins the names by dots: `agent.color`.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from . import _options

__all__ = ["Box", "Dict", "Discrete", "MultiDiscrete", "RGBBox", "reset_variation_space"]


class OutsideError(ValueError, AssertionError):
    """A value is not in its space, or violates a condition."""


#: The number of samples after which a condition is considered impossible.
TRIES = 1000


class _Slow:
    """Warns once if sampling takes longer than some seconds."""

    def __init__(self, space: Any, seconds: float) -> None:
        self.space, self.until = space, time.monotonic() + seconds

    def check(self) -> None:
        if time.monotonic() > self.until:
            self.until = float("inf")
            warnings.warn(f"sampling {self.space} takes long: few samples satisfy its constrain_fn", stacklevel=4)


class _Factor:
    """A mixin that turns a Gymnasium space into a factor."""

    constrain_fn: Callable[[Any], bool] | None
    _init_value: Any
    _value: Any

    def _begin(self, init_value: Any, constrain_fn: Callable[[Any], bool] | None) -> None:
        self.constrain_fn = constrain_fn
        # A default outside of the space is allowed; `check` reports it.
        self._init_value = _copied(self._typed(init_value) if isinstance(init_value, (list, tuple)) else init_value)
        self._value = _copied(self._init_value)

    def _typed(self, value: Any) -> Any:
        """The value in the type of the space, unless the conversion to integers is inexact, or a finite value is too large."""
        try:
            with np.errstate(over="ignore"):
                typed = np.asarray(value, dtype=self.dtype)  # type: ignore[attr-defined]
        except OverflowError:
            return np.asarray(value)
        if typed.dtype.kind == "f":
            infinite = np.isinf(typed)
            fits = not infinite.any() or np.isinf(np.asarray(value, dtype=np.float64)[infinite]).all()
        else:
            fits = np.array_equal(typed, np.asarray(value))
        return typed if fits else np.asarray(value)

    @property
    def init_value(self) -> Any:
        """A copy of the default value."""
        return _copied(self._init_value)

    @property
    def value(self) -> Any:
        """The current value."""
        return self._value

    def reset(self) -> None:
        """Sets the value to the default."""
        self._value = _copied(self._init_value)

    def contains(self, x: Any) -> bool:
        """Whether a value is in the space and satisfies the condition."""
        return bool(super().contains(x)) and (self.constrain_fn is None or bool(self.constrain_fn(x)))  # type: ignore[misc]

    def check(self) -> bool:
        """Whether the current value is allowed."""
        return self.contains(self._value)

    def sample(
        self, mask: Any = None, max_tries: int = TRIES, warn_after_s: float = 5.0, set_value: bool = True, **kwargs: Any
    ) -> Any:
        """Samples until the condition holds.

        Args:
            mask: As for Gymnasium's space.
            max_tries: The largest number of tries.
            warn_after_s: Seconds after which a warning says that the condition is hard to satisfy.
            set_value: Whether the sample becomes the value.
            **kwargs: Further arguments of Gymnasium's space: `probability`.
        """
        # `probability` is passed only if given, because Gymnasium supports it since 1.1.
        given = {name: value for name, value in kwargs.items() if value is not None}
        slow = _Slow(self, warn_after_s)
        for _ in range(max_tries):
            slow.check()
            value = super().sample(mask=mask, **given)  # type: ignore[misc]
            if self.contains(value):
                if set_value:
                    self._value = value
                return value
        raise RuntimeError(
            f"no sample of {self} satisfied its constrain_fn in {max_tries} tries; widen the space or the condition"
        )

    def _allowed(self, value: Any) -> Any:
        typed = self._typed(value)
        if not self.contains(typed):
            raise OutsideError(f"{value!r} is not in {self}, or violates its constrain_fn")
        return _copied(typed)

    def set_init_value(self, value: Any) -> None:
        """Changes the default."""
        self._init_value = self._allowed(value)

    def set_value(self, value: Any) -> None:
        """Changes the current value."""
        self._value = self._allowed(value)


def _copied(value: Any) -> Any:
    """A value whose changes in place change no other."""
    return value.copy() if isinstance(value, np.ndarray) else value


class Box(_Factor, spaces.Box):  # type: ignore[misc]
    """Values within bounds."""

    def __init__(
        self,
        low: Any,
        high: Any,
        shape: Sequence[int] | None = None,
        init_value: Any = None,
        constrain_fn: Callable[[Any], bool] | None = None,
        dtype: Any = np.float32,
        **kwargs: Any,
    ) -> None:
        spaces.Box.__init__(self, low, high, shape=shape, dtype=dtype, **kwargs)
        self._begin(init_value, constrain_fn)


class RGBBox(Box):
    """One or several colours: integers from 0 to 255, with an axis of size 3."""

    def __init__(self, shape: Sequence[int] = (3,), init_value: Any = None, **kwargs: Any) -> None:
        if 3 not in tuple(shape):
            raise ValueError(f"RGBBox: expected a shape with an axis of size 3, got {tuple(shape)}")
        super().__init__(low=0, high=255, shape=shape, dtype=np.uint8, init_value=init_value, **kwargs)


class Discrete(_Factor, spaces.Discrete):  # type: ignore[misc]
    """An integer from `start` to `start + n - 1`."""

    def __init__(
        self,
        n: int,
        init_value: Any = None,
        constrain_fn: Callable[[Any], bool] | None = None,
        **kwargs: Any,
    ) -> None:
        spaces.Discrete.__init__(self, n, **kwargs)
        self._begin(init_value, constrain_fn)

    def _typed(self, value: Any) -> Any:
        return int(value) if int(value) == value else value


class MultiDiscrete(_Factor, spaces.MultiDiscrete):  # type: ignore[misc]
    """Several integers; the `i`-th one has `nvec[i]` possible values."""

    def __init__(
        self,
        nvec: Any,
        init_value: Any = None,
        constrain_fn: Callable[[Any], bool] | None = None,
        **kwargs: Any,
    ) -> None:
        spaces.MultiDiscrete.__init__(self, nvec, **kwargs)
        self._begin(init_value, constrain_fn)


class Dict(spaces.Dict):
    """Factors by name, nested: a `variation_space`.

    Factors are sampled in `sampling_order`, then in the order of `spaces` (Gymnasium sorts the keys of a dict), so the
    condition of a factor may read the values of earlier factors. All factors are sampled again until the condition of the
    whole `Dict` holds. Spaces of Gymnasium without a value may be members; they are sampled only.
    """

    def __init__(
        self,
        spaces_dict: Mapping[str, spaces.Space[Any]] | None = None,
        init_value: Mapping[str, Any] | None = None,
        constrain_fn: Callable[[dict[str, Any]], bool] | None = None,
        sampling_order: Sequence[str] | None = None,
        **kwargs: Any,
    ) -> None:
        members = dict(spaces_dict or {})
        super().__init__(members, **kwargs)
        self.spaces: dict[str, Any]
        self.constrain_fn = constrain_fn
        named = list(sampling_order or [])
        unknown = [key for key in named if key not in self.spaces]
        if unknown:
            raise ValueError(f"sampling_order names {unknown}, which are not among {list(self.spaces)}")
        self._sampling_order = named + [key for key in self.spaces if key not in named]
        if init_value is not None:
            self.set_init_value(dict(self._flat(init_value)))
            self.reset()

    @property
    def init_value(self) -> dict[str, Any]:
        """The defaults, nested as the spaces are."""
        return {key: space.init_value if _has_value(space) else space.sample() for key, space in self.spaces.items()}

    @property
    def value(self) -> dict[str, Any]:
        """The current values, nested as the spaces are."""
        plain = [key for key, space in self.spaces.items() if not _has_value(space)]
        if plain:
            raise ValueError(f"{plain} are spaces of Gymnasium, which have no value; use those of stable_worldmodel.spaces")
        return {key: space.value for key, space in self.spaces.items()}

    @property
    def sampling_order(self) -> list[str]:
        """Every group and factor by its dot key, in the order in which they are sampled."""
        order = []
        for key in self._sampling_order:
            order.append(key)
            if isinstance(self.spaces[key], Dict):
                order.extend(f"{key}.{inner}" for inner in self.spaces[key].sampling_order)
        return order

    def names(self) -> list[str]:
        """The dot keys of all factors."""
        return [key for key, _ in self.factors()]

    def factors(self) -> Iterator[tuple[str, Any]]:
        """Every factor with its dot key."""
        for key, space in self.spaces.items():
            if isinstance(space, Dict):
                yield from ((f"{key}.{inner}", factor) for inner, factor in space.factors())
            else:
                yield key, space

    def find(self, key: str) -> Any:
        """The factor or group of a dot key."""
        space: Any = self
        for part in key.split("."):
            if not isinstance(space, Dict) or part not in space.spaces:
                raise ValueError(f"there is no factor {key!r}; the factors are {self.names()}")
            space = space.spaces[part]
        return space

    def reset(self) -> None:
        """Sets every factor to its default."""
        for space in filter(_has_value, self.spaces.values()):
            space.reset()

    def contains(self, x: Any) -> bool:
        """Whether every value is in its space and all conditions hold."""
        return (
            isinstance(x, Mapping)
            and all(key in x and space.contains(x[key]) for key, space in self.spaces.items())
            and (self.constrain_fn is None or bool(self.constrain_fn(dict(x))))
        )

    def check(self, debug: bool = False) -> bool:
        """Whether every current value is in its space and all conditions hold."""
        wrong = list(self._wrong())
        if debug and wrong:
            names = ", ".join(wrong)
            warnings.warn(f"the values of {names} are outside their spaces or violate a constrain_fn", stacklevel=2)
        return not wrong and self._holds()

    def _wrong(self) -> Iterator[str]:
        """The dot keys of the factors and groups whose values are outside their spaces or violate their conditions."""
        for key, space in self.spaces.items():
            if isinstance(space, Dict):
                inside = [f"{key}.{inner}" for inner in space._wrong()]
                # A condition may not support values outside of the spaces.
                yield from inside if inside or space._holds() else [key]
            elif _has_value(space) and not space.check():
                yield key

    def _holds(self) -> bool:
        """Whether the current values satisfy the condition of the `Dict` itself."""
        return self.constrain_fn is None or bool(self.constrain_fn(self.value))

    def sample(  # type: ignore[override]
        self, mask: Any = None, max_tries: int = TRIES, warn_after_s: float = 5.0, set_value: bool = True, **kwargs: Any
    ) -> dict[str, Any]:
        """Samples every factor, in order, until the condition of the `Dict` holds.

        Args:
            mask: The masks of the factors, by key.
            max_tries: The largest number of tries.
            warn_after_s: Seconds after which a warning says that the condition is hard to satisfy.
            set_value: Whether the samples become the values.
            **kwargs: `probability`: the probabilities of the factors, by key.
        """
        masks, chances = mask or {}, kwargs.get("probability") or {}
        slow = _Slow(self, warn_after_s)
        for _ in range(max_tries):
            slow.check()
            value = {
                key: self._sampled(self.spaces[key], masks.get(key), set_value, chances.get(key))
                for key in self._sampling_order
            }
            if self.constrain_fn is None or self.constrain_fn(value):
                return {key: value[key] for key in self.spaces}
        raise RuntimeError(f"the factors' common constrain_fn did not hold in {max_tries} tries; relax it or narrow the spaces")

    @staticmethod
    def _sampled(space: Any, mask: Any, set_value: bool, probability: Any) -> Any:
        if not _has_value(space):
            return space.sample(mask)
        return space.sample(mask, set_value=set_value, probability=probability)

    def update(self, keys: Iterable[str]) -> None:
        """Samples these factors and groups in sampling order, until the conditions of all groups that they are in hold.

        `all` selects every factor.
        """
        selected = set(keys)
        if "all" in selected:
            self.sample()
            return
        for key in selected:
            self.find(key)
        self._update(selected)

    def _update(self, selected: set[str]) -> None:
        for _ in range(TRIES):
            for key in self._sampling_order:
                if key in selected:
                    self.spaces[key].sample()
                elif inner := {name.removeprefix(f"{key}.") for name in selected if name.startswith(f"{key}.")}:
                    self.spaces[key]._update(inner)
            if self._holds():
                return
        raise RuntimeError(
            f"the common constrain_fn of {', '.join(self.spaces)} did not hold in {TRIES} tries; vary all of them, or others"
        )

    def set_init_value(self, variations_values: Mapping[str, Any]) -> None:
        """Changes defaults, by dot key."""
        for key, value in self._flat(variations_values):
            self.find(key).set_init_value(value)

    def set_value(self, variations_values: Mapping[str, Any]) -> None:
        """Changes current values, by dot key."""
        for key, value in self._flat(variations_values):
            self.find(key).set_value(value)

    def _flat(self, values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
        for key, value in values.items():
            name = f"{before}{key}"
            if isinstance(value, Mapping):
                yield from self._flat(value, f"{name}.")
            else:
                yield name, value

    def to_str(self) -> str:
        """The tree of factors as text, one factor per line."""
        lines = []
        for key, space in self.spaces.items():
            if isinstance(space, Dict):
                lines += [f"{key}:", *(f"    {line}" for line in space.to_str().splitlines())]
            else:
                lines.append(f"{key}: {space}")
        return "\n".join(lines)


def _has_value(space: Any) -> bool:
    """Whether a space is one of this module."""
    return isinstance(space, (_Factor, Dict))


def reset_variation_space(
    variation_space: Dict,
    seed: int | None = None,
    options: Mapping[str, Any] | None = None,
    default_variations: Iterable[str] | None = None,
) -> None:
    """Resets the factors of an environment for an episode.

    Sets all factors to their defaults, samples the factors in `options["variation"]` (`default_variations` if it is
    missing), and sets the factors in `options["variation_values"]`: a colour (`RGBBox`) of floats that are all from 0 to 1 has
    fractions of 255, as in `World.reset`.
    """
    options = options or {}
    variation_space.seed(seed)
    variation_space.reset()
    names = options.get("variation")
    names = default_variations or () if names is None else names
    variation_space.update([names] if isinstance(names, str) else names)
    values = dict(variation_space._flat(options.get("variation_values") or {}))
    for key, value in values.items():
        if isinstance(variation_space.find(key), RGBBox) and _options.are_fractions(value):
            values[key] = np.round(255 * np.asarray(value))
    variation_space.set_value(values)
    if not variation_space.check():
        raise OutsideError(f"some factors are outside their spaces or violate a constrain_fn: {variation_space.value}")


def from_description(described: Mapping[str, Any]) -> spaces.Space[Any]:
    """Builds a space from its description by the engine."""
    kind = described["type"]
    if kind == "Dict":
        return spaces.Dict({key: from_description(inner) for key, inner in described["spaces"].items()})
    factor = "init_value" in described
    more = {"init_value": _default(described)} if factor else {}
    if kind == "Discrete":
        return (Discrete if factor else spaces.Discrete)(described["n"], start=described["start"], **more)
    if kind == "MultiDiscrete":
        # Gymnasium batches `Discrete` spaces without a start.
        return (MultiDiscrete if factor else spaces.MultiDiscrete)(
            np.asarray(described["nvec"]), start=np.asarray(described["start"]), **more
        )
    if kind == "RGBBox":
        return RGBBox(shape=tuple(described["shape"]), **more)
    dtype = np.dtype(described["dtype"])
    low, high = (
        np.array(_unbounded(described[side], bound), dtype=np.float64) for side, bound in (("low", -np.inf), ("high", np.inf))
    )
    shape = tuple(described["shape"])
    low, high = (np.broadcast_to(side, shape).astype(dtype) for side in (low, high))
    return (Box if factor else spaces.Box)(low, high, shape=shape, dtype=dtype.type, **more)


def _default(described: Mapping[str, Any]) -> Any:
    """The default of a factor, in the type of its space."""
    if described["type"] == "Discrete":
        return int(described["init_value"])
    kinds = {"MultiDiscrete": np.int64, "RGBBox": np.uint8}
    dtype = kinds.get(described["type"]) or np.dtype(described["dtype"])
    value = np.asarray(described["init_value"], dtype=dtype)
    return value if "shape" not in described else value.reshape(tuple(described["shape"]))


def _unbounded(bounds: Any, bound: float) -> Any:
    """The bounds, with `None` (infinity in the engine's JSON) replaced by `bound`."""
    if isinstance(bounds, list):
        return [_unbounded(inner, bound) for inner in bounds]
    return bound if bounds is None else bounds


def variation_space(factors: Mapping[str, Mapping[str, Any]], order: Sequence[str]) -> Dict:
    """Builds the nested spaces of an environment's factors from descriptions by dot key, in sampling order."""
    tree: dict[str, Any] = {}
    for key in order:
        if key in factors:
            *groups, name = key.split(".")
            node = tree
            for group in groups:
                node = node.setdefault(group, {})
            node[name] = from_description(factors[key])

    def nested(node: Mapping[str, Any]) -> Dict:
        members = {key: nested(inner) if isinstance(inner, dict) else inner for key, inner in node.items()}
        return Dict(members, sampling_order=list(node))

    return nested(tree)
