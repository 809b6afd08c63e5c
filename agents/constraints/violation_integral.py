"""The integral of the violations, with which CPO and PCPO correct their linear model.

A constrained trust-region step solves b.x + c <= 0: c is the violation, b.x the predicted change of the
cost. Both come from one rollout, and the step follows the noise of b. So the cost falls by less than
predicted. It settles above the limit, where the realised fall balances the rise that the rest of the step
causes. An integral term removes this steady error, as in every controller:

    I <- max(I + K min(c, e), 0),    if c = 0: I <- (1 - K) I;    the step solves b.x + c + I <= 0.

e = sqrt(d^2 + s^2), d the limit and s the standard error of the cost, bounds what a violation adds. An
episode costs at least 0, so c is at least -d, but an untrained policy may exceed the limit by any amount.
Without the bound a few such updates would add more than hundreds of later ones could subtract. An agent that
has long kept the limit would still avoid all cost. The multipliers' integral is bounded likewise
(``multiplier_rules.pid``).

If the last step could not meet its constraint, a larger I would change nothing, and would delay the return to
the reward. Then I does not grow (anti-wind-up). Under a limit of 0 c is never negative: there I falls only by
the second rule, while c is 0.

c, e and I are in the unit of the surrogates, cost per step, so K has no unit. K = 0 is the published
algorithm.

Notation: k costs, j of the k limits are finite.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats


class ViolationIntegral:
    """The integral I of the module, one number per cost.

    Args:
        gain: K, per update, at least 0; with 0 the integral stays 0.
        num_costs: k.
    """

    def __init__(self, gain: float, num_costs: int) -> None:
        self._gain = gain
        self._integral = np.zeros(num_costs)
        self._unmet = np.zeros(num_costs, dtype=np.bool_)

    @property
    def values(self) -> Floats:
        """I, cost per step, at least 0, [k]."""
        return self._integral.copy()

    def corrected(self, index: npt.NDArray[np.int64], violations: Floats, sizes: Floats) -> Floats:
        """Include new violations; return c + I, [j].

        Args:
            index: of the costs that have a limit, [j].
            violations: c, cost per step, [j].
            sizes: e, the largest violation that counts, cost per step, at least 0, [j].
        """
        change = self._gain * np.minimum(violations, sizes)
        grows = np.where(self._unmet[index], np.minimum(change, 0.0), change)
        forgotten = np.where(violations == 0.0, self._gain * self._integral[index], 0.0)
        self._integral[index] = np.maximum(self._integral[index] + grows - forgotten, 0.0)
        corrected: Floats = violations + self._integral[index]
        return corrected

    def note_step(self, index: npt.NDArray[np.int64], unmet: npt.NDArray[np.bool_]) -> None:
        """Remember which of the constraints, [j], the step taken could not meet."""
        self._unmet[:] = False
        self._unmet[index] = unmet

    def state_dict(self) -> dict[str, Any]:
        """Return the integral, and which constraints the last step did not meet, [k] each."""
        return {"integral": self._integral.copy(), "unmet": self._unmet.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._integral = np.array(state["integral"], np.float64)
        self._unmet = np.array(state["unmet"], np.bool_)
