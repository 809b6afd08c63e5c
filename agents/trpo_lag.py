"""TRPO on the Lagrangian (Ray et al. 2019, section 5).

Multipliers first answer the gaps; then the policy takes one trust-region step up the surrogate of
(A_r - sum_i p_i A_i) / (1 + sum_i p_i), p the multipliers. If no episode finished, the multipliers stay.

Letters: N samples, k costs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from recrl.agents.actor_critic import ActorCritic, Constraints, indexed, initial_networks
from recrl.agents.advantages import penalised_advantages, scaled_advantages
from recrl.agents.batch import LearningBatch
from recrl.agents.config import TRPOLagConfig
from recrl.agents.multipliers import Multipliers
from recrl.agents.policies import StochasticPolicy
from recrl.agents.trpo import improve_within_trust_region
from recrl.environments.cmdp import CMDPSpec, Floats


class TRPOLagrangian:
    """The rule of ``trpo-lag``; a ``recrl.agents.actor_critic.PolicyRule``."""

    def __init__(self, config: TRPOLagConfig, num_costs: int) -> None:
        self._config = config
        self._multipliers = Multipliers(config, num_costs)

    def improve(
        self,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> dict[str, float]:
        """Move the multipliers, then the policy."""
        multipliers = self._multipliers.answer(constraints)
        rewards, costs = scaled_advantages(advantages, self._config.cost_advantages)
        objective = penalised_advantages(rewards, costs, multipliers)
        metrics = improve_within_trust_region(
            policy, batch, advantages, objective=objective, config=self._config
        )
        return {**metrics, **indexed("multiplier", multipliers)}

    def state_dict(self) -> dict[str, Any]:
        """The multipliers, and the limits last seen."""
        return self._multipliers.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._multipliers.load_state_dict(state)


def make_trpo_lag(cmdp: CMDPSpec, config: TRPOLagConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh TRPO-Lagrangian student."""
    policy, critics = initial_networks(cmdp, config, seed)
    return ActorCritic(cmdp, config, policy, critics, TRPOLagrangian(config, cmdp.num_costs))
