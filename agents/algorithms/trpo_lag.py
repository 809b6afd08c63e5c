"""TRPO on the Lagrangian (Ray et al. 2019, section 5).

First the multipliers p are updated from the gaps. Then the policy takes one trust-region step on the
surrogate of (A_r - sum_i p_i A_i) / (1 + sum_i p_i).

At a saddle point of the Lagrangian that surrogate has no gradient. A step to the edge of the trust region has
the same length there as elsewhere, so the policy would oscillate about the limit. So, ours, the KL is
subtracted with the coefficient ``kl_penalty``, and steps get shorter as the gain falls.

Notation: N samples, k costs.
"""

from __future__ import annotations

import numpy as np

from recrl.agents.algorithms.own_options import TRPOLagConfig
from recrl.agents.algorithms.trpo import trust_region_step
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.constraints.multipliers import Multipliers
from recrl.agents.experience import Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.policy_rule import Stateful, indexed
from recrl.environments.cmdp import CMDPSpec


class TRPOLagrangian:
    """The rule of ``trpo-lag``; a ``recrl.agents.learning.policy_rule.PolicyRule``."""

    def __init__(self, config: TRPOLagConfig, num_costs: int) -> None:
        self._config = config
        self._multipliers = Multipliers(config, num_costs)
        self.parts: dict[str, Stateful] = {"multipliers": self._multipliers}

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Move the multipliers, then the policy."""
        penalty = self._multipliers.update(experience)
        metrics = trust_region_step(
            policy,
            experience,
            penalty.advantages,
            self._config,
            generator,
            kl_penalty=self._config.kl_penalty,
        )
        return {**metrics, **indexed("multiplier", penalty.task_multipliers)}


def make_trpo_lag(cmdp: CMDPSpec, config: TRPOLagConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new TRPO-Lagrangian agent."""
    return fresh_agent(cmdp, config, seed, lambda _: TRPOLagrangian(config, cmdp.num_costs))
