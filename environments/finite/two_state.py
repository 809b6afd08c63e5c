"""Two small CMDPs with a closed-form constrained optimum, for testing learners.

There are two states, a camp and a mine. An episode starts in the camp, where the reward is 0, also on the way
to the mine: an agent must look ahead. In the mine a careful step earns 1. A hasty step earns 2 and wears the
tools. A reckless step earns 3, wears the tools and makes noise. All of them stay in the mine. ``two-state``
has the first two and the cost ``wear``; ``two-state-2`` has all three and the costs ``wear`` and ``noise``.

Observation: one-hot state (camp, mine), float32 [2].
Action: Discrete(2) or Discrete(3). In the camp 0 waits and any other goes; in the mine 0 is careful, 1 hasty
    and 2 reckless.
Reward: 0 in the camp; 1, 2 or 3 in the mine.
Cost: ``wear`` 1 a hasty or reckless step in the mine, ``noise`` 1 a reckless step.
Termination: never; truncated after ``horizon`` steps.
Source: ours.

With n the expected number of steps in the mine of an agent that goes at once,

    J*(d) = n + min(d_wear, n) + min(d_wear, d_noise, n),    n = sum_{t=1}^{H-1} (1 - (1 - p)^t),

where p is the chance that a step towards the mine arrives: n = H - 1 for p = 1. A *stationary* policy is
optimal: go; be reckless with probability min(d_wear, d_noise, n) / n and hasty with the rest of min(d_wear,
n) / n.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from recrl.environments.cmdp import CostLimits
from recrl.environments.finite.finite_cmdp import FiniteCMDP, FiniteVectorEnv
from recrl.environments.options import Options

CAMP, MINE = 0, 1
COST_NAMES = ("wear", "noise")
NUM_COSTS = {"two-state": 1, "two-state-2": 2}


class TwoStateOptions(Options):
    """Settings of ``two-state`` and ``two-state-2``."""

    horizon: int = Field(default=10, ge=2, le=10_000, description="H, steps in an episode (ours).")
    arrival: float = Field(
        default=1.0, gt=0.0, le=1.0, description="p, probability that a step towards the mine arrives (ours)."
    )


def two_state_cmdp(options: TwoStateOptions, num_costs: int) -> FiniteCMDP:
    """Return the tables: A = k + 1 actions, k = ``num_costs`` of 1 (``wear``) or 2 (``wear``, ``noise``)."""
    num_actions = num_costs + 1
    to_mine = np.full((2, num_actions), options.arrival)
    to_mine[CAMP, 0] = 0.0
    to_mine[MINE] = 1.0
    rewards = np.zeros((2, num_actions))
    rewards[MINE] = 1.0 + np.arange(num_actions)
    costs = np.zeros((2, num_actions, num_costs))
    for index in range(num_costs):
        costs[MINE, index + 1 :, index] = 1.0
    return FiniteCMDP(
        successors=np.tile(np.array([CAMP, MINE]), (2, num_actions, 1)),
        probabilities=np.stack([1.0 - to_mine, to_mine], axis=2),
        rewards=rewards,
        costs=costs,
        terminal=np.zeros(2, np.bool_),
        start=np.array([1.0, 0.0]),
        horizon=options.horizon,
        cost_names=COST_NAMES[:num_costs],
    )


def expected_steps_in_mine(options: TwoStateOptions) -> float:
    """Expected steps in the mine of an agent that goes at once, n = sum_{t<H} (1 - (1 - p)^t).

    >>> expected_steps_in_mine(TwoStateOptions(horizon=10))
    9.0
    """
    steps = np.arange(1, options.horizon)
    return float(np.sum(1.0 - (1.0 - options.arrival) ** steps))


def two_state_optimum(name: str, options: TwoStateOptions, limits: CostLimits) -> float:
    """Return J*(d) for the task's one or two limits, by the formula of the module's docstring.

    >>> two_state_optimum("two-state", TwoStateOptions(horizon=10), CostLimits((3.0,)))
    12.0
    >>> two_state_optimum("two-state-2", TwoStateOptions(horizon=10), CostLimits((5.0, 2.0)))
    16.0
    """
    limits.require_one_per_cost(NUM_COSTS[name], name)
    mine = expected_steps_in_mine(options)
    hasty_or_reckless = min(limits[0], mine)
    reckless = min(hasty_or_reckless, limits[1]) if NUM_COSTS[name] == 2 else 0.0
    return mine + hasty_or_reckless + reckless


def make_two_state(name: str, num_envs: int, options: TwoStateOptions) -> FiniteVectorEnv:
    """B environments of ``two-state`` (k = 1) or ``two-state-2`` (k = 2)."""
    model = two_state_cmdp(options, NUM_COSTS[name])
    return FiniteVectorEnv(name, model, np.eye(2, dtype=np.float32), num_envs=num_envs)
