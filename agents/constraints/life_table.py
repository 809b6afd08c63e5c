"""Life table: an estimate of the mean episode cost from the steps of finished and unfinished episodes.

Notation: T steps, B environments, k costs, A ages.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from recrl.agents.agent import Rollout
from recrl.agents.building_blocks.scales import quotient
from recrl.environments.cmdp import Floats


@dataclass(frozen=True, eq=False)
class LifeTableMeans:
    """Means over episodes, by a life table.

    Attributes:
        costs: mean episode costs J, [k].
        length: mean episode length, the sum of S_t, at least 1.
        number: number of episodes: the steps at each age, averaged. The average is the harmonic one, weighted
            by S_t, as the variance of a mean falls with 1 / steps.
    """

    costs: Floats
    length: float
    number: float


class LifeTable:
    """Mean episode cost from the steps of episodes, finished or not, by age: the number of earlier steps.

    Episodes that finish in a rollout much shorter than they are were begun many updates ago, while the
    rollout's steps are of the current policy. But these steps may belong to one part of the episodes only.
    If episodes end after similar times, the environments become synchronised. So every age has its own mean,

        J = sum over ages t of S_t c_t,  S_t = product over u < t of (1 - h_u),

    with c_t the mean cost of a step of age t, and h_t the fraction of such steps that ended an episode
    (Kaplan and Meier 1958). Both are exponential averages: if a rollout has n steps of that age, it counts n,
    and all earlier ones together count what ``window`` steps lack. So ages that few episodes reach have older
    steps. Until the table has whole episodes, J is too low, as later ages count 0.

    Args:
        window: the least number of steps that an age counts, at least 1; fewer only at the start.
        num_costs: k.
    """

    def __init__(self, window: int, num_costs: int) -> None:
        self._window = window
        self._steps: Floats = np.zeros(0)
        self._sums: Floats = np.zeros((1 + num_costs, 0))

    def add(self, rollout: Rollout) -> None:
        """Include the T x B steps of a rollout."""
        ages, ended = rollout.ages().ravel(), rollout.terminated | rollout.truncated
        steps = np.bincount(ages, minlength=len(self._steps)).astype(np.float64)
        counted = [ended, *np.moveaxis(rollout.costs, -1, 0)]
        sums = np.array([np.bincount(ages, each.ravel(), len(steps)) for each in counted])
        new_ages = len(steps) - len(self._steps)
        earlier = np.pad(self._steps, (0, new_ages))
        earlier_sums = np.pad(self._sums, ((0, 0), (0, new_ages)))
        kept = np.clip(self._window - steps, 0.0, earlier)
        self._steps = steps + kept
        self._sums = sums + quotient(kept, earlier) * earlier_sums

    def means(self) -> LifeTableMeans:
        """Return the means over episodes, after at least one ``add``."""
        ending, *costs = quotient(self._sums, self._steps)
        survival = np.cumprod(np.concatenate([[1.0], 1.0 - ending[:-1]]))
        number = survival.sum() / (survival @ quotient(np.ones_like(self._steps), self._steps))
        return LifeTableMeans(np.array(costs) @ survival, float(survival.sum()), float(number))

    def state_dict(self) -> dict[str, Any]:
        """Return the number of steps of each age, [A], and their sums of ends and costs, [1 + k, A]."""
        return {"steps": self._steps.copy(), "sums": self._sums.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._steps = np.array(state["steps"], np.float64)
        self._sums = np.array(state["sums"], np.float64)
