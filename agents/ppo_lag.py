"""PPO on the Lagrangian (Ray et al. 2019, section 5).

Multipliers first answer the gaps; then the policy climbs the penalised surrogate in at most ``policy_steps``
full-batch steps, and stops when it has moved too far. If no episode finished, nothing is known about the
constraints: the multipliers stay.

The objective is (L_r - sum_i p_i L_i) / (1 + sum_i p_i), p the multipliers. ``separate`` clips the reward's
surrogate only (the paper's students); ``combined`` clips the surrogate of the penalised advantage
A_r - sum_i p_i A_i, so that the policy gains nothing from leaving the clip range for a cost's sake either.

Letters: N samples, D decisions, k costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from torch import Tensor

from recrl.agents.actor_critic import ActorCritic, Constraints, indexed, initial_networks
from recrl.agents.advantages import penalised_advantages, scaled_advantages
from recrl.agents.ascent import ascend, with_entropy
from recrl.agents.batch import LearningBatch
from recrl.agents.config import PPOLagConfig
from recrl.agents.multipliers import Multipliers
from recrl.agents.networks import Adam
from recrl.agents.policies import StochasticPolicy
from recrl.agents.surrogates import SignedAdvantages, clipped_surrogate, surrogate
from recrl.environments.cmdp import CMDPSpec, Floats


class PPOLagrangian:
    """The rule of ``ppo-lag``; a ``recrl.agents.actor_critic.PolicyRule``."""

    def __init__(self, config: PPOLagConfig, policy: StochasticPolicy, num_costs: int) -> None:
        self._config = config
        self._optimiser = Adam(policy.parameters, config.policy_learning_rate)
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
        gain = self._objective(batch, advantages, multipliers)
        objective = with_entropy(gain, batch, self._config.entropy_bonus)
        metrics = ascend(policy, self._optimiser, batch, advantages, objective=objective, config=self._config)
        return {**metrics, **indexed("multiplier", multipliers)}

    def _objective(
        self, batch: LearningBatch, advantages: Floats, multipliers: Floats
    ) -> Callable[[Tensor], Tensor]:
        """What the policy climbs, as a function of the decisions' probability ratios, [D]."""
        config = self._config
        rewards, costs = scaled_advantages(advantages, config.cost_advantages)
        if config.penalty == "combined":
            penalised = SignedAdvantages.split(batch, penalised_advantages(rewards, costs, multipliers))
            return lambda ratios: clipped_surrogate(ratios, penalised, config.clip)
        weight = 1.0 / (1.0 + float(multipliers.sum()))
        signed = SignedAdvantages.split(batch, weight * rewards)
        penalty = batch.per_decision(weight * (costs @ multipliers))
        return lambda ratios: clipped_surrogate(ratios, signed, config.clip) - surrogate(ratios, penalty)

    def state_dict(self) -> dict[str, Any]:
        """The policy's optimiser, the multipliers, and the limits last seen."""
        return {"optimiser": self._optimiser.state_dict(), **self._multipliers.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._optimiser.load_state_dict(state["optimiser"])
        self._multipliers.load_state_dict(state)


def make_ppo_lag(cmdp: CMDPSpec, config: PPOLagConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh PPO-Lagrangian student."""
    policy, critics = initial_networks(cmdp, config, seed)
    return ActorCritic(cmdp, config, policy, critics, PPOLagrangian(config, policy, cmdp.num_costs))
