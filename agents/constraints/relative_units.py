"""Units in which the advantages of the reward and of every cost have the same spread.

A weight of costs against the reward, be it a multiplier or the factor of a penalty, has the unit reward per
cost. Counted in u_i = spread of the reward's advantages / spread of cost i's advantages, it does not depend
on the task's units. Both spreads are running root mean squares over all updates, because the unit must not
change with the policy.

Notation: N samples, k costs, j of them have a limit and have occurred.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.agents.building_blocks.advantages import reward_spread
from recrl.agents.building_blocks.scales import RunningScale, quotient
from recrl.agents.experience import ActiveConstraints, Experience
from recrl.environments.cmdp import Floats

# Smallest spread of the reward's advantages in a rollout, as a fraction of a cost's in the same unit. If all
# rewards are equal, costs would be scaled without bound, and Adam would remember it for thousands of steps.
LEAST_SPREAD = 0.1


@dataclass(frozen=True, eq=False)
class RelativeAdvantages:
    """Advantages in common units.

    Attributes:
        rewards: standardised advantages, [N]; smaller in a rollout in which costs differ much more.
        costs: centred advantages of each cost times its ``factors``, [N, k].
        factors: u_i / s, [k]; 0 if the cost has not occurred. s is the spread of the reward's advantages in
            this rollout, and at least ``LEAST_SPREAD`` times that of each limited cost's, in units of reward.
            Before any reward, 1 / the spread of the cost's: costs are avoided from the start.
        exchange_rates: u, reward per unit of cost, [k]; 0 before any reward or cost i.
    """

    rewards: Floats
    costs: Floats
    factors: Floats
    exchange_rates: Floats


class RelativeUnits:
    """The units u of the module.

    Args:
        num_costs: k.
    """

    def __init__(self, num_costs: int) -> None:
        self._spreads = RunningScale(1 + num_costs)

    def of(self, advantages: Floats, limits: Floats) -> RelativeAdvantages:
        """Include a rollout's advantages in the spreads, and scale them.

        Args:
            advantages: raw, [N, 1 + k].
            limits: in force, [k]; a cost whose limit is infinite does not count for the scale.
        """
        centred = advantages - advantages.mean(axis=0)
        self._spreads.add((centred**2).mean(axis=0))
        of_reward, of_costs = self._spreads.values[:1], self._spreads.values[1:]
        exchange_rates = quotient(of_reward, of_costs)
        in_reward = np.where(np.isfinite(limits), exchange_rates * centred[:, 1:].std(axis=0), 0.0)
        spread = max(reward_spread(centred), LEAST_SPREAD * float(in_reward.max(initial=0.0)))
        factors = exchange_rates / spread if of_reward > 0.0 else quotient(np.ones(1), of_costs)
        return RelativeAdvantages(centred[:, 0] / spread, centred[:, 1:] * factors, factors, exchange_rates)

    def state_dict(self) -> dict[str, Any]:
        """Return the spreads."""
        return self._spreads.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._spreads.load_state_dict(state)


@dataclass(frozen=True, eq=False)
class RelativeConstraints:
    """The constraints that can bind, in the units of ``RelativeAdvantages``.

    Attributes:
        rewards: see ``RelativeAdvantages``, [N].
        costs: centred advantages of these costs times their factors, [N, j].
        violations: (mean episode cost - limit) / mean episode length, times the factors, [j].
        index: of the j costs, [j].
        exchange_rates: u of all costs, reward per unit of cost, [k].
    """

    rewards: Floats
    costs: Floats
    violations: Floats
    index: npt.NDArray[np.int64]
    exchange_rates: Floats

    @classmethod
    def of(cls, experience: Experience, units: RelativeUnits) -> RelativeConstraints:
        """Include the rollout's advantages in the units, and scale advantages and known gaps."""
        scaled = units.of(experience.advantages, experience.constraints.limits)
        active = ActiveConstraints.of(experience.constraints)
        occurred = scaled.factors[active.index] > 0.0
        index = active.index[occurred]
        violations = scaled.factors[index] * active.violations[occurred]
        return cls(scaled.rewards, scaled.costs[:, index], violations, index, scaled.exchange_rates)

    def in_reward_per_cost(self, weights: Floats) -> Floats:
        """Return weights of the j costs in the task's units, 0 for the others, [j] -> [k]."""
        all_weights = np.zeros_like(self.exchange_rates)
        all_weights[self.index] = weights * self.exchange_rates[self.index]
        return all_weights
