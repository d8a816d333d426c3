"""Whether an exported file flies as the checkpoint that it came from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uavrl.evaluation.rollouts import EvaluationSet, fly
from uavrl.policies.base import Policy

EQUAL = 1e-4  # of a return: float32 rounds in another order


class Verification(NamedTuple):
    """Returns of the same flights, of the checkpoint and of the file; (N,)."""

    trained: NDArray[np.float64]
    exported: NDArray[np.float64]

    @property
    def difference(self) -> NDArray[np.float64]:
        """(N,) exported less trained."""
        return self.exported - self.trained

    @property
    def equal(self) -> int:
        """Flights whose returns agree to a ten-thousandth."""
        return int((np.abs(self.difference) <= EQUAL * np.abs(self.trained)).sum())

    @property
    def agrees(self) -> bool:
        """Whether the mean difference is within three of its standard errors, or a ten-thousandth of the return.

        A tie that rounding breaks the other way leads a single flight elsewhere; a wrong graph leads all of them.
        """
        error = self.difference.std() / np.sqrt(len(self.difference))
        return bool(abs(self.difference.mean()) <= 3.0 * error + EQUAL * abs(self.trained.mean()))


def verify(trained: Policy, exported: Policy, environments: EvaluationSet, *, deterministic: bool) -> Verification:
    """Fly both; a file that samples takes other noise than the checkpoint, so only its mean is comparable."""

    def returns(policy: Policy, wanted: bool) -> NDArray[np.float64]:
        flights = fly(policy, environments, deterministic=wanted, show_progress=True)
        total: NDArray[np.float64] = (flights.reward * flights.active).sum(axis=0)
        return total

    return Verification(returns(trained, deterministic), returns(exported, deterministic))
