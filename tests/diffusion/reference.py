"""The published noise schedules in NumPy float64, apart from the package's code."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def reference_beta(name: str, steps: int) -> Array:
    """Variance (M,) that each step adds."""
    i = np.arange(1, steps + 1)
    line = 1e-4 + (2e-2 - 1e-4) * (i - 1) / max(steps - 1, 1)
    signal = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
    beta: Array = {
        "vp": 1 - np.exp(-0.1 / steps - 0.5 * 9.9 * (2 * i - 1) / steps**2),
        "cosine": np.minimum(1 - signal[1:] / signal[:-1], 0.999),
        "linear": line,
        "linear_rescaled": np.minimum((line if steps > 1 else np.array([2e-2])) * 1000 / steps, 0.999),
    }[name]
    return beta
