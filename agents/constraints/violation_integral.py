"""The integral of the violations, with which CPO and PCPO correct their linear model.

A constrained trust-region step solves b.x + c <= 0: c is the violation, b.x the predicted change of the
cost. Both come from one rollout, and the step follows the noise of b. So the cost falls by less than
predicted. It converges above the limit, where the realised fall balances the rise that the rest of the step
causes. An integral of the gap g, the mean episode cost minus the limit, removes this steady error, as in
every controller. safety-starter-agents' CPO has it as an option that is off by default (``learn_margin``,
K = 0.05). It lacks what follows here on e, on costs of 0 and on the bound:

    I <- max(I + K min(g, e), 0)    before the step; c is computed from g + I in place of g,
    I <- min(I, d + r)              after the step.

**Where nothing costs.** If the mean episode cost is 0, c is computed from g. There is no cost to lower, and b
is the noise of the cost's critic. Otherwise an I above d would ask for a cost below 0.

**What a gap adds.** e = sqrt(d^2 + s^2), d the limit and s the standard error of the cost. An episode costs
at least 0, so g is at least -d, but an untrained policy may exceed the limit by any amount. Without e a few
such updates would add more than hundreds of later ones could subtract. An agent that has long kept the limit
would still avoid all cost. If d and s are 0, e is g. The multipliers' integral has the same e
(``multiplier_rules.proportional_integral``).

**The bound (anti-wind-up).** r is the running mean of the largest fall of the cost that a step in the trust
region predicts. With an I above d + r a step can hardly meet the constraint, even if an episode cost 0. Such
an I would only delay the return to the reward, above all after the limit has fallen. A bound that is reached
often biases the cost, because it removes high gaps and no low ones. So I still grows where no step can meet
the constraint at the present g + I. And r is a mean: that of a single update is small where its rollout
happened to cost little.

**Limits of 0.** Under a limit of 0 g is never negative. There, while nothing costs, I falls by K I.

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

REACH_DECAY = 0.9  # of r, per update


class ViolationIntegral:
    """The integral I of the module, one number per cost.

    Args:
        gain: K, per update, at least 0; with 0 the integral stays 0.
        num_costs: k.
    """

    def __init__(self, gain: float, num_costs: int) -> None:
        self._gain = gain
        self._integral = np.zeros(num_costs)
        self._reach = np.full(num_costs, np.nan)

    @property
    def values(self) -> Floats:
        """I, episode cost, at least 0, [k]."""
        return self._integral.copy()

    def corrected(self, constraints: Constraints) -> Constraints:
        """Include new gaps, all known; return the constraints with the gaps from which c is computed."""
        index = np.flatnonzero(np.isfinite(constraints.limits))
        gaps, limits = constraints.gaps[index], constraints.limits[index]
        sizes = np.hypot(limits, constraints.standard_errors[index])
        change = self._gain * np.where(sizes > 0.0, np.minimum(gaps, sizes), gaps)
        costless = gaps + limits <= 0.0
        forgotten = np.where(costless & (limits == 0.0), self._gain * self._integral[index], 0.0)
        self._integral[index] = np.maximum(self._integral[index] + change - forgotten, 0.0)
        corrected = constraints.gaps.copy()
        corrected[index] = np.where(costless, gaps, gaps + self._integral[index])
        return replace(constraints, gaps=corrected)

    def bound(self, index: npt.NDArray[np.int64], limits: Floats, reach: Floats) -> None:
        """Include the reach of a step in r, and set I to min(I, d + r).

        Args:
            index: the constraints, [j].
            limits: d, [j].
            reach: the largest fall of each cost that this update's step could predict, episode cost, [j].
        """
        old = self._reach[index]
        self._reach[index] = np.where(np.isnan(old), reach, REACH_DECAY * old + (1.0 - REACH_DECAY) * reach)
        self._integral[index] = np.minimum(self._integral[index], limits + self._reach[index])

    def state_dict(self) -> dict[str, Any]:
        """Return the integral and the mean reach, [k] each."""
        return {"integral": self._integral.copy(), "reach": self._reach.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._integral = np.array(state["integral"], np.float64)
        self._reach = np.array(state.get("reach", np.full(len(self._integral), np.nan)), np.float64)
