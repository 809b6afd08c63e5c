"""The Lagrange multipliers of a student: a rule of ``recrl.agents.lagrange``, its state, and when it moves.

If no episode finished, nothing is known about the constraints and the multipliers stay. A cost whose limit is
infinite has the multiplier 0. With ``multiplier_waits`` nothing is summed up while the teacher adds noise or
rewards entropy: what the student could not have avoided would have to be undone later, update by update.

Letters: k costs.
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
        self._noisy_step = without_sum(config) if config.multiplier_waits else self._step
        self._restarts = config.multiplier_reset
        self._last_limits = np.full(num_costs, np.nan)

    def answer(self, constraints: Constraints) -> Floats:
        """Move with the gaps, unless they are unknown; the multipliers in force, [k]."""
        if self._restarts:
            changed = (constraints.limits != self._last_limits) & ~np.isnan(self._last_limits)
            self._state = restarted(self._state, self._start, changed)
        self._last_limits = constraints.limits.copy()
        if constraints.known:
            step = self._noisy_step if constraints.noisy else self._step
            self._state = step(self._state, constraints.gaps, constraints.limits)
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


def without_sum(config: MultiplierConfig) -> MultiplierRule:
    """The multiplier rule that the options name, without what it sums up: PID's integral, or all of it."""
    return pid_step(config, integral=0.0) if config.multiplier_rule == "pid" else lambda state, *_: state


def multiplier_step(config: MultiplierConfig) -> MultiplierRule:
    """The multiplier rule that the options name, as a function of state, gaps and limits."""
    if config.multiplier_rule == "softplus-adam":
        return lambda state, gaps, _: softplus_adam(state, gaps, learning_rate=config.multiplier_step)
    if config.multiplier_rule == "projected":
        units, maximum = gain_units(config), config.multiplier_maximum
        return lambda state, gaps, limits: projected_ascent(
            state, gaps, step_size=config.multiplier_step / units(limits), maximum=maximum
        )
    return pid_step(config, integral=config.multiplier_step)


def pid_step(config: MultiplierConfig, *, integral: float) -> MultiplierRule:
    """The PID rule with the options' gains, but for that of the integral."""
    units = gain_units(config)
    return lambda state, gaps, limits: pid(
        state,
        gaps,
        limits,
        proportional=config.multiplier_proportional / units(limits),
        integral=integral / units(limits),
        derivative=config.multiplier_derivative / units(limits),
        maximum=config.multiplier_maximum,
        geometric=config.multiplier_geometric,
    )


def gain_units(config: MultiplierConfig) -> Callable[[Floats], Floats]:
    """What steps and gains are per, as a function of the limits."""
    return limit_units if config.multiplier_unit == "limit" else np.ones_like
