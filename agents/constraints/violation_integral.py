"""The integral of the violations, with which CPO and PCPO correct their linear model.

A constrained trust-region step solves b.x + c <= 0: c is the violation, b.x the predicted change of the
cost. Both come from one rollout, and the step follows the noise of b. So the cost falls by less than
predicted. It converges above the limit, where the realised fall balances the rise that the rest of the step
causes. An integral of the gap g, the mean episode cost minus the limit, removes this steady error, as in
every controller:

    I <- max(I + K min(g, e), 0),    if d = 0 and g is negligible beside I: I <- (1 - K) I;

c is computed from g + I in place of g. e = sqrt(d^2 + s^2), d the limit and s the standard error of the cost,
bounds what a gap adds. An episode costs at least 0, so g is at least -d, but an untrained policy may exceed
the limit by any amount. Without the bound a few such updates would add more than hundreds of later ones could
subtract. An agent that has long kept the limit would still avoid all cost. The multipliers' integral is
bounded likewise (``multiplier_rules.proportional_integral``).

If a step could not meet its constraint, a larger I would not have changed it. But the next g may be far lower.
If I stopped growing after every such step, it would count all low gaps and miss many of the high ones. Then
the cost would stay above the limit. So I stops growing (anti-wind-up) only after a step that could not meet
its constraint even if an episode cost 0, that is with g = -d. Under a limit of 0 g is never negative: there I
falls only by the second rule. A life table's estimate only approaches 0, so g needs not be 0 exactly.

g, e and I are in episode cost, so K has no unit. In cost per step the request I would grow with the length of
the episodes, as robots learn not to fall. K = 0 is the published algorithm.

Notation: k costs, j of the k limits are finite.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.agents.experience import Constraints
from recrl.environments.cmdp import Floats

NEGLIGIBLE = 1e-6


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
        """I, episode cost, at least 0, [k]."""
        return self._integral.copy()

    def corrected(self, constraints: Constraints) -> Constraints:
        """Include new gaps, all known; return the constraints with g + I as the gaps of finite limits."""
        index = np.flatnonzero(np.isfinite(constraints.limits))
        gaps = constraints.gaps[index]
        sizes = np.hypot(constraints.limits[index], constraints.standard_errors[index])
        change = self._gain * np.minimum(gaps, sizes)
        grows = np.where(self._unmet[index], np.minimum(change, 0.0), change)
        kept = (constraints.limits[index] == 0.0) & (gaps <= NEGLIGIBLE * self._integral[index])
        forgotten = np.where(kept, self._gain * self._integral[index], 0.0)
        self._integral[index] = np.maximum(self._integral[index] + grows - forgotten, 0.0)
        corrected = constraints.gaps.copy()
        corrected[index] = gaps + self._integral[index]
        return replace(constraints, gaps=corrected)

    def without_cost(self, constraints: Constraints) -> Constraints:
        """Return the constraints with I - d as the gaps of finite limits, as if an episode cost 0."""
        finite = np.isfinite(constraints.limits)
        gaps = np.where(finite, self._integral - constraints.limits, constraints.gaps)
        return replace(constraints, gaps=gaps)

    def note_step(self, index: npt.NDArray[np.int64], unmet: npt.NDArray[np.bool_]) -> None:
        """Remember which of the constraints, [j], the step taken could not meet even ``without_cost``."""
        self._unmet[:] = False
        self._unmet[index] = unmet

    def state_dict(self) -> dict[str, Any]:
        """Return the integral, and which constraints the last step did not meet, [k] each."""
        return {"integral": self._integral.copy(), "unmet": self._unmet.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._integral = np.array(state["integral"], np.float64)
        self._unmet = np.array(state["unmet"], np.bool_)
