"""Scalers of columns. They can be pickled and accept arrays and tensors."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from .. import _torch
from . import _tensors
from ._tensors import Array

__all__ = ["ColumnTransform", "IdentityScaler", "PercentileScaler", "ZScoreScaler", "column_normalizer", "get_scaler"]

Values = TypeVar("Values")


def _is_tensor(value: Any) -> bool:
    torch = _torch.loaded()
    return torch is not None and isinstance(value, torch.Tensor)


def _like(value: Any, *bounds: Array | None) -> list[Any]:
    """The bounds as arrays, or as tensors with the type and device of `value`."""
    if any(bound is None for bound in bounds):
        raise ValueError("the scaler is not fitted: call fit first, or pass its parameters to the constructor")
    if not _is_tensor(value):
        return list(bounds)
    import torch

    return [torch.as_tensor(bound, dtype=value.dtype, device=value.device) for bound in bounds]


def _real(value: Any) -> Any:
    """The values, with integers and booleans of a tensor in double precision, as numpy does, and half in single precision."""
    if not _is_tensor(value):
        return value
    if not value.is_floating_point():
        return value.double()
    return value.float() if value.element_size() < 4 else value


def _as_given(scaled: Any, given: Any) -> Any:
    """Scaled values in the half precision of the given ones."""
    half = _is_tensor(given) and given.is_floating_point() and given.element_size() < 4
    return scaled.to(given.dtype) if half else scaled


def _finite_rows(values: Any) -> Array:
    """The rows `(n, d)` without NaN. The missing action of an episode's last row is NaN.

    Raises:
        ValueError: If there is no such row, or a number is infinite, complex or masked.
    """
    if np.ma.is_masked(values):
        raise ValueError("fit: the values have masked ones; leave them out, with `compressed`, or fill them with `filled`")
    array = _tensors.to_numpy(values)
    if array.dtype.kind == "c":
        raise ValueError(f"fit: expected real numbers, got {array.dtype}")
    array = array.astype(np.float64) if array.dtype == bool else array
    array = array.reshape(-1, array.shape[-1] if array.ndim > 1 else 1)
    array = array[~np.isnan(array).any(axis=1)]
    if len(array) == 0:
        raise ValueError("fit: expected at least one row without NaN")
    if infinite := int(np.isinf(array).any(axis=1).sum()):
        raise ValueError(f"fit: {infinite} of {len(array)} rows have an infinite number; leave them out")
    return array


class IdentityScaler:
    """A scaler that does not change values."""

    def fit(self, X: Any) -> IdentityScaler:
        """Does nothing."""
        return self

    def transform(self, X: Values) -> Values:
        """Returns the values unchanged."""
        return X

    def inverse_transform(self, X: Values) -> Values:
        """Returns the values unchanged."""
        return X

    def fit_transform(self, X: Values) -> Values:
        """Returns the values unchanged."""
        return X

    def __call__(self, X: Values) -> Values:
        return X


class _Affine:
    """Base class of scalers of the form `(x - centre) / scale` per dimension."""

    def _bounds(self) -> tuple[Array | None, Array | None]:
        """The centre and the scale."""
        raise NotImplementedError

    def fit(self, X: Any) -> Any:
        """Fits the scaler to values `(..., d)`; rows with NaN are ignored."""
        raise NotImplementedError

    def transform(self, X: Any) -> Any:
        """The scaled values, `(..., d)`."""
        real = _real(X)
        centre, scale = _like(real, *self._bounds())
        return _as_given((real - centre) / scale, X)

    def inverse_transform(self, X: Any) -> Any:
        """The original values of scaled values, `(..., d)`."""
        real = _real(X)
        centre, scale = _like(real, *self._bounds())
        return _as_given(real * scale + centre, X)

    def fit_transform(self, X: Any) -> Any:
        """Fits the scaler to the values and scales them."""
        return self.fit(X).transform(X)

    def __call__(self, X: Any) -> Any:
        scaled = self.transform(X)
        return scaled.float() if _is_tensor(scaled) else scaled


class ZScoreScaler(_Affine):
    """Scales to mean 0 and standard deviation 1 in every dimension; deviations below `eps` count as `eps`."""

    def __init__(self, mean: Any = None, std: Any = None, eps: float = 1e-8) -> None:
        self.mean = None if mean is None else np.asarray(mean)
        self.std = None if std is None else np.asarray(std)
        self.eps = eps

    def fit(self, X: Any) -> ZScoreScaler:
        """Fits the scaler to values `(..., d)`; rows with NaN are ignored."""
        rows = _finite_rows(X)
        # Sums of many numbers need double precision; results have the precision of the column, at least single.
        kind = np.result_type(rows.dtype, np.float32) if rows.dtype.kind == "f" else np.float64
        self.mean = rows.mean(axis=0, keepdims=True, dtype=np.float64).astype(kind)
        self.std = rows.std(axis=0, keepdims=True, dtype=np.float64).astype(kind)
        return self

    def _bounds(self) -> tuple[Array | None, Array | None]:
        return self.mean, None if self.std is None else np.maximum(self.std, self.eps)


class PercentileScaler(_Affine):
    """Maps the range between two percentiles to -1 .. 1 and clips values outside of it."""

    def __init__(self, low: float = 1.0, high: float = 99.0, q_low: Any = None, q_high: Any = None, eps: float = 1e-8) -> None:
        if not 0 <= low < high <= 100:
            raise ValueError(f"expected percentiles 0 <= low < high <= 100, got {low} and {high}")
        self.low = low
        self.high = high
        self.q_low = None if q_low is None else np.asarray(q_low)
        self.q_high = None if q_high is None else np.asarray(q_high)
        self.eps = eps

    def fit(self, X: Any) -> PercentileScaler:
        """Fits the scaler to values `(..., d)`; rows with NaN are ignored."""
        rows = _finite_rows(X)
        # Differences of neighbours may be beyond integers and half precision.
        wide = rows if rows.dtype == np.float32 else rows.astype(np.float64)
        self.q_low, self.q_high = np.percentile(wide, [self.low, self.high], axis=0).astype(
            np.result_type(rows.dtype, np.float32)
        )
        return self

    def _bounds(self) -> tuple[Array | None, Array | None]:
        if self.q_low is None or self.q_high is None:
            return None, None
        return (self.q_low + self.q_high) / 2, np.maximum(self.q_high - self.q_low, self.eps) / 2

    def transform(self, X: Any) -> Any:
        """The scaled values, `(..., d)`."""
        scaled = super().transform(X)
        return scaled.clamp(-1, 1) if _is_tensor(scaled) else np.clip(scaled, -1, 1)


_SCALERS: dict[str, Any] = {"zscore": ZScoreScaler, "percentile": PercentileScaler, "none": IdentityScaler}


def get_scaler(method: str = "zscore", **kwargs: Any) -> Any:
    """A scaler that is not fitted yet: `"zscore"`, `"percentile"` or `"none"`."""
    if method not in _SCALERS:
        raise ValueError(f"unknown scaler {method!r}; the scalers are {', '.join(_SCALERS)}")
    return _SCALERS[method](**kwargs)


class ColumnTransform:
    """A transform of samples: `sample[target] = scaler(sample[source])`."""

    def __init__(self, scaler: Any, source: str, target: str) -> None:
        self.scaler = scaler
        self.source = source
        self.target = target

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        sample[self.target] = self.scaler(sample[self.source])
        return sample


def column_normalizer(dataset: Any, source: str, target: str, method: str = "zscore") -> ColumnTransform:
    """A transform that scales a column with a scaler fitted to the dataset's values of that column.

    Args:
        dataset: An object with `get_col_data`.
        source: The column to read.
        target: The column to write; may equal `source`.
        method: `"zscore"`, `"percentile"` or `"none"`.
    """
    scaler = get_scaler(method)
    if method != "none":
        scaler.fit(dataset.get_col_data(source))
    return ColumnTransform(scaler, source, target)
