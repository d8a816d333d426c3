"""What NumPy, torch and Python's own numbers share: the Array API's functions, and vectors of the plane."""

from __future__ import annotations

import math
import operator
from typing import Any

import array_api_compat
import numpy as np

Array = Any  # a NumPy array, torch tensor or number; the Array API has no common type to name


class _Numbers:
    """The Array API's functions for one Python number: NumPy takes ten times as long to do the same."""

    abs, exp, sqrt, atan = staticmethod(abs), staticmethod(math.exp), staticmethod(math.sqrt), staticmethod(math.atan)
    log1p, log10, logical_not = staticmethod(math.log1p), staticmethod(math.log10), staticmethod(operator.not_)
    minimum, maximum, remainder = staticmethod(min), staticmethod(max), staticmethod(operator.mod)

    @staticmethod
    def where(condition: bool, yes: Any, no: Any) -> Any:
        return yes if condition else no

    @staticmethod
    def zeros_like(value: Any) -> Any:
        return type(value)(0)

    @staticmethod
    def stack(values: tuple[float, ...], axis: int) -> Array:
        return np.array(values)


_PLAIN = (float, int, bool)


def array_namespace(array: Array) -> Any:
    """The Array API's functions for this array. NumPy 2 has them itself, and calls them several times as fast."""
    if isinstance(array, np.ndarray):
        return np
    return _Numbers if type(array) in _PLAIN else array_api_compat.array_namespace(array)


def per_device(value: Array) -> Array:
    """(...) as (..., 1), to meet (..., K); a plain number meets anything as it is."""
    return value if type(value) in _PLAIN else value[..., None]


def components(vector: Array) -> tuple[Array, Array]:
    """x and y (...) of (..., 2) vectors; of a single NumPy vector, plain numbers."""
    if vector.ndim == 1 and isinstance(vector, np.ndarray):
        x, y = vector.tolist()
        return x, y
    return vector[..., 0], vector[..., 1]


def length(x: Array, y: Array) -> Array:
    """Euclidean length (...) of vectors, exactly 0 and with a gradient of 0 at the zero vector.

    The plain root has the gradient inf * 0 = NaN there: whenever the aircraft hovers, or the border holds it.
    """
    xp = array_namespace(x)
    squared = x * x + y * y
    return squared / xp.sqrt(squared + 1e-37)  # a normal number of float32, far below any squared length
