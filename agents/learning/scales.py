"""The sizes of quantities whose unit is the task's own, so that no setting of an agent has to know that unit.

Critics learn targets divided by their running root mean square; multipliers are counted in the ratio of the
running spreads of reward and cost advantages. Multiply a task's rewards by 1,000, or its costs and limits,
and the policies stay what they were (van Hasselt et al. 2016; Stooke et al. 2020).

Every update counts the same, however long ago it was: a scale that forgets would move for as long as the
policy does, and what is counted in it with it. Notation: m quantities.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from recrl.environments.cmdp import Floats


class RunningScale:
    """The root of the mean over all updates of m mean squares.

    Args:
        size: m.
    """

    def __init__(self, size: int) -> None:
        self._updates = 0
        self._mean_squares: Floats = np.zeros(size)

    @property
    def values(self) -> Floats:
        """The scales, [m]; 0 of what has been 0 so far."""
        scales: Floats = np.sqrt(self._mean_squares)
        return scales

    @property
    def is_known(self) -> bool:
        """Whether any update was added."""
        return self._updates > 0

    def add(self, mean_squares: Floats) -> None:
        """Include one update's mean squares, [m]."""
        self._updates += 1
        self._mean_squares = self._mean_squares + (mean_squares - self._mean_squares) / self._updates

    def state_dict(self) -> dict[str, Any]:
        """The number of updates and the mean of their mean squares, [m]."""
        return {"updates": self._updates, "mean_squares": self._mean_squares.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._updates = int(state["updates"])
        self._mean_squares = np.array(state["mean_squares"], np.float64)


def quotient(dividend: Floats, divisor: Floats) -> Floats:
    """``dividend`` / ``divisor``, element by element; 0 where the divisor is 0.

    >>> quotient(np.array([6.0, 1.0]), np.array([3.0, 0.0]))
    array([2., 0.])
    """
    return np.divide(
        dividend, divisor, out=np.zeros(np.broadcast(dividend, divisor).shape), where=divisor != 0
    )
