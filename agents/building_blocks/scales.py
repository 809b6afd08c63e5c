"""Running scales of quantities in the task's units, so that no setting of an agent depends on those units.

Critics learn targets divided by their running root mean square. The unit of multipliers is the ratio of the
running spreads of reward and cost advantages. If a task's rewards, or its costs and limits, are multiplied by
1,000, the policies are the same (van Hasselt et al. 2016; Stooke et al. 2020).

Every update has the same weight: with a moving average the unit would change as long as the policy does. Only
the first one counts twice in the scale of the targets, because critics need a scale before they learn.
Notation: m quantities.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from recrl.environments.cmdp import Floats


class RunningScale:
    """Root of the mean over all updates of m mean squares.

    Args:
        size: m.
    """

    def __init__(self, size: int) -> None:
        self._updates = 0
        self._mean_squares: Floats = np.zeros(size)

    @property
    def values(self) -> Floats:
        """The scales, [m]; 0 for a quantity that has always been 0."""
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


class MovingScale:
    """Root of a moving average of m squares, in which the newest update has the weight 1 - ``decay``.

    Args:
        decay: at least 0, below 1; with 0 the scale is that of the newest update.
        size: m.
    """

    def __init__(self, decay: float, size: int) -> None:
        self._decay = decay
        self._weight = 0.0
        self._squares: Floats = np.zeros(size)

    def including(self, values: Floats) -> Floats:
        """Include one update's values, [m], at least 0; return the scales, [m].

        >>> scale = MovingScale(0.5, 1)
        >>> scale.including(np.array([2.0])), scale.including(np.array([5.0])) ** 2
        (array([2.]), array([18.]))
        """
        if self._decay == 0.0:
            return values
        self._weight = self._decay * self._weight + 1.0 - self._decay
        self._squares = self._decay * self._squares + (1.0 - self._decay) * values**2
        scales: Floats = np.sqrt(self._squares / self._weight)
        return scales

    def state_dict(self) -> dict[str, Any]:
        """The weights of all updates so far together, and the weighted sum of their squares, [m]."""
        return {"weight": self._weight, "squares": self._squares.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._weight = float(state["weight"])
        self._squares = np.array(state["squares"], np.float64)


def quotient(dividend: Floats, divisor: Floats) -> Floats:
    """Return ``dividend`` / ``divisor``, element by element; 0 where the divisor is 0.

    >>> quotient(np.array([6.0, 1.0]), np.array([3.0, 0.0]))
    array([2., 0.])
    """
    return np.divide(
        dividend, divisor, out=np.zeros(np.broadcast(dividend, divisor).shape), where=divisor != 0
    )
