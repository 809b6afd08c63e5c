"""The Lagrange multipliers of an agent: a rule of ``constraints.multiplier_rules``, its state, and its units.

An update first changes the multipliers by the violations. Then it scales the advantages of reward and costs
to the multipliers' units: the agent ascends A_r - sum_i mu_i A_i.

``multiplier_unit: relative`` does not depend on the task's units. Violations are relative
(``relative_gaps``), and multipliers mu_i are in the units u_i of ``constraints.relative_units``. In reward
per unit of cost, the multiplier of the CMDP is lambda_i = mu_i u_i. ``cost`` is the paper's: violations in
episode cost, standardised reward advantages, raw cost advantages.

A relative violation is divided by a standard error. The error of one update is large where its mean cost is,
so violations count less than slack. Then the mean cost settles above the limit. ``multiplier_error_decay``
replaces it by the root of a moving average of squared errors.

A cost with an infinite limit has the multiplier 0.

Notation: N samples, k costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from recrl.agents.building_blocks.advantages import penalised_advantages, reward_spread
from recrl.agents.building_blocks.scales import MovingScale
from recrl.agents.constraints.multiplier_rules import (
    STARTS,
    MultiplierState,
    projected_ascent,
    proportional_integral,
    relative_gaps,
    softplus_adam,
)
from recrl.agents.constraints.relative_units import RelativeUnits
from recrl.agents.experience import Constraints, Experience
from recrl.agents.shared_options import LagrangianConfig
from recrl.environments.cmdp import Floats

# (state, gaps in the rule's unit [k]) -> the next state
MultiplierRule = Callable[[MultiplierState, Floats], MultiplierState]


@dataclass(frozen=True, eq=False)
class Penalty:
    """Advantages and multipliers in common units.

    Attributes:
        rewards: standardised advantages, [N].
        costs: centred advantages in the multipliers' unit, [N, k].
        multipliers: mu, [k], at least 0.
        task_multipliers: lambda, the reported multipliers, [k].
    """

    rewards: Floats
    costs: Floats
    multipliers: Floats
    task_multipliers: Floats

    @property
    def advantages(self) -> Floats:
        """Advantages of the Lagrangian, (A_r - sum_i mu_i A_i) / (1 + sum_i mu_i), [N]."""
        return penalised_advantages(self.rewards, self.costs, self.multipliers)


class Multipliers:
    """One multiplier per cost, updated by the rule of the options.

    Args:
        config: the rule, its gains and its unit.
        num_costs: k.
    """

    def __init__(self, config: LagrangianConfig, num_costs: int) -> None:
        self._state: MultiplierState = STARTS[config.multiplier_rule](num_costs, config.multiplier_initial)
        self._is_relative = config.multiplier_unit == "relative"
        self._step = multiplier_step(config)
        self._units = RelativeUnits(num_costs)
        self._errors = MovingScale(config.multiplier_error_decay, num_costs)

    def update(self, experience: Experience) -> Penalty:
        """Update the multipliers; return the scaled advantages."""
        multipliers = self.move(experience.constraints)
        if self._is_relative:
            scaled = self._units.of(experience.advantages, experience.constraints.limits)
            return Penalty(scaled.rewards, scaled.costs, multipliers, multipliers * scaled.exchange_rates)
        centred = experience.advantages - experience.advantages.mean(axis=0)
        return Penalty(centred[:, 0] / reward_spread(centred), centred[:, 1:], multipliers, multipliers)

    def move(self, constraints: Constraints) -> Floats:
        """Update the multipliers; return them, mu, [k]."""
        gaps = constraints.gaps
        if self._is_relative:
            errors = self._errors.including(constraints.standard_errors)
            gaps = relative_gaps(gaps, constraints.limits, errors)
        self._state = self._step(self._state, gaps)
        return np.where(np.isfinite(constraints.limits), self._state["multipliers"], 0.0)

    def state_dict(self) -> dict[str, Any]:
        """Return the rule's state, the units and the standard errors."""
        return {
            "multipliers": {key: values.copy() for key, values in self._state.items()},
            "units": self._units.state_dict(),
            "errors": self._errors.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._state = {key: np.array(values, np.float64) for key, values in state["multipliers"].items()}
        self._units.load_state_dict(state["units"])
        if errors := state.get("errors"):  # a checkpoint of an earlier version has none
            self._errors.load_state_dict(errors)


def multiplier_step(config: LagrangianConfig) -> MultiplierRule:
    """Return the multiplier rule of the options, as a function of state and gaps."""
    step, maximum = config.multiplier_step, config.multiplier_maximum
    if config.multiplier_rule == "softplus-adam":
        return lambda state, gaps: softplus_adam(state, gaps, learning_rate=step)
    if config.multiplier_rule == "projected":
        return lambda state, gaps: projected_ascent(state, gaps, step_size=step, maximum=maximum)
    return lambda state, gaps: proportional_integral(
        state,
        gaps,
        largest=1.0 if config.multiplier_unit == "relative" else np.inf,
        proportional=config.multiplier_proportional,
        integral=step,
        maximum=maximum,
    )
