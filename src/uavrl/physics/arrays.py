"""What NumPy and torch share: the Array API's functions, and a vector's length."""

from __future__ import annotations

from typing import Any

import array_api_compat
import numpy as np

Array = Any  # a NumPy array or torch tensor; the Array API has no common type to name


def array_namespace(array: Array) -> Any:
    """The Array API's functions for this array. NumPy 2 has them itself, and calls them several times as fast."""
    return np if isinstance(array, np.ndarray) else array_api_compat.array_namespace(array)


def length(vector: Array) -> Array:
    """Euclidean length (...) of (..., 2) vectors, exactly 0 and with a gradient of 0 at the zero vector.

    The plain root has the gradient inf * 0 = NaN there: whenever the aircraft hovers, or the border holds it.
    """
    xp = array_namespace(vector)
    x, y = vector[..., 0], vector[..., 1]
    squared = x * x + y * y
    return squared / xp.sqrt(squared + 1e-37)  # a normal number of float32, far below any squared length
