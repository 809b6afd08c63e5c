"""Penalised proximal policy optimisation (Zhang et al. 2022): an exact penalty instead of multipliers.

The policy climbs, in cost per step,

    L_r - kappa sum_i max(0, L_i + c_i),  c_i = (mean episode cost i - limit i) / mean episode length,

with L_r the clipped surrogate of the reward and L_i that of cost i, which is *pessimistic about cost*: the
mean of max(ratio A_i, clip(ratio) A_i). The penalty is exact: if kappa exceeds every multiplier of the
constrained problem, both have the same optimum, and nothing has to adapt. All advantages and c are divided by
the standard deviation of the reward's, so that kappa is in reward per unit of cost, as multipliers are.

If no episode finished, nothing is known about the constraints and the policy stays. Letters: N samples, D
decisions, k costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from recrl.agents.actor_critic import ActorCritic, Constraints, indexed, initial_networks
from recrl.agents.advantages import reward_spread, scaled_advantages
from recrl.agents.ascent import ascend, with_prices
from recrl.agents.batch import LearningBatch
from recrl.agents.config import P3OConfig
from recrl.agents.cpo import ActiveConstraints
from recrl.agents.networks import Adam
from recrl.agents.policies import StochasticPolicy
from recrl.agents.surrogates import SignedAdvantages, clipped_surrogate
from recrl.environments.cmdp import CMDPSpec, Floats


def penalised_gain(
    batch: LearningBatch, advantages: Floats, active: ActiveConstraints, *, clip: float, factor: float
) -> Callable[[Tensor], tuple[Tensor, float]]:
    """The module's formula, a function of the ratios, with the sum of the penalty factors in force.

    Args:
        batch: the collapsed samples.
        advantages: raw, [N, 1 + k].
        active: the constraints that have a limit.
        clip: e in (0, 1).
        factor: kappa.
    """
    rewards, costs = scaled_advantages(advantages, "reward-scaled")
    violations = (active.violations / reward_spread(advantages)).tolist()
    signed = SignedAdvantages.split(batch, rewards)
    # The pessimistic surrogate of a cost is minus that of its negative.
    relief = [SignedAdvantages.split(batch, -costs[:, i]) for i in active.index]

    def gain(ratios: Tensor) -> tuple[Tensor, float]:
        value, price = clipped_surrogate(ratios, signed, clip), 0.0
        for each, violation in zip(relief, violations, strict=True):
            excess = violation - clipped_surrogate(ratios, each, clip)
            value = value - factor * torch.relu(excess)
            price += factor * float(excess.detach() > 0.0)
        return value, price

    return gain


class PenalisedProximalPolicyOptimisation:
    """The rule of ``p3o``; a ``recrl.agents.actor_critic.PolicyRule``."""

    def __init__(self, config: P3OConfig, policy: StochasticPolicy) -> None:
        self._config = config
        self._optimiser = Adam(policy.parameters, config.policy_learning_rate)

    def improve(
        self,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> dict[str, float]:
        """Climb the penalised surrogate, unless nothing is known about the constraints."""
        config = self._config
        objective = None
        multipliers = np.full_like(constraints.limits, np.nan)
        if constraints.known:
            active = ActiveConstraints.of(constraints)
            gain = penalised_gain(batch, advantages, active, clip=config.clip, factor=config.penalty_factor)
            objective = with_prices(gain)
            multipliers = np.where(constraints.gaps > 0.0, config.penalty_factor, 0.0)
        metrics = ascend(policy, self._optimiser, batch, advantages, objective=objective, config=config)
        return {**metrics, **indexed("multiplier", multipliers)}

    def state_dict(self) -> dict[str, Any]:
        """The policy's optimiser."""
        return {"optimiser": self._optimiser.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._optimiser.load_state_dict(state["optimiser"])


def make_p3o(cmdp: CMDPSpec, config: P3OConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh P3O student."""
    policy, critics = initial_networks(cmdp, config, seed)
    return ActorCritic(cmdp, config, policy, critics, PenalisedProximalPolicyOptimisation(config, policy))
