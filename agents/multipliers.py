"""The Lagrange multipliers of a student: a rule of ``recrl.agents.lagrange``, its state, and when it moves.

If no episode finished, nothing is known about the constraints and the multipliers stay. A cost whose limit is
infinite has the multiplier 0. Letters: k costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from recrl.agents.config import MultiplierConfig
from recrl.agents.experience import Constraints
from recrl.agents.lagrange import (
    STARTS,
    MultiplierState,
    limit_units,
    pid,
    projected_ascent,
    restarted,
    softplus_adam,
)
from recrl.environments.cmdp import Floats

# (state, gaps J - d [k], limits d [k]) -> the next state
MultiplierRule = Callable[[MultiplierState, Floats, Floats], MultiplierState]


class Multipliers:
    """One multiplier a cost, moved by the rule that the options name.

    Args:
        config: the rule and its gains.
        num_costs: k.
    """

    def __init__(self, config: MultiplierConfig, num_costs: int) -> None:
        self._start = STARTS[config.multiplier_rule](num_costs, config.multiplier_initial)
        self._state: MultiplierState = self._start
        self._step = multiplier_step(config)
        self._restarts = config.multiplier_reset
        self._last_limits = np.full(num_costs, np.nan)

    def answer(self, constraints: Constraints) -> Floats:
        """Move with the gaps, unless they are unknown; the multipliers in force, [k]."""
        if self._restarts:
            changed = (constraints.limits != self._last_limits) & ~np.isnan(self._last_limits)
            self._state = restarted(self._state, self._start, changed)
        self._last_limits = constraints.limits.copy()
        if constraints.known:
            self._state = self._step(self._state, constraints.gaps, constraints.limits)
        return np.where(np.isfinite(constraints.limits), self._state["multipliers"], 0.0)

    def state_dict(self) -> dict[str, Any]:
        """The rule's state, and the limits last seen."""
        return {
            "multipliers": {key: values.copy() for key, values in self._state.items()},
            "last_limits": self._last_limits.copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._state = {key: np.array(values, np.float64) for key, values in state["multipliers"].items()}
        self._last_limits = np.array(state["last_limits"], np.float64)


def multiplier_step(config: MultiplierConfig) -> MultiplierRule:
    """The multiplier rule that the options name, as a function of state, gaps and limits."""
    units = limit_units if config.multiplier_unit == "limit" else np.ones_like
    maximum = config.multiplier_maximum
    if config.multiplier_rule == "softplus-adam":
        return lambda state, gaps, _: softplus_adam(state, gaps, learning_rate=config.multiplier_step)
    if config.multiplier_rule == "projected":
        return lambda state, gaps, limits: projected_ascent(
            state, gaps, step_size=config.multiplier_step / units(limits), maximum=maximum
        )
    return lambda state, gaps, limits: pid(
        state,
        gaps,
        limits,
        proportional=config.multiplier_proportional / units(limits),
        integral=config.multiplier_step / units(limits),
        derivative=config.multiplier_derivative / units(limits),
        maximum=maximum,
    )
