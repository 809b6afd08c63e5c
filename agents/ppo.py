"""Proximal policy optimisation (Schulman et al. 2017): the control that knows no constraint.

Its objective is the clipped surrogate of the standardised reward advantages. Costs are learnt and reported,
as with every student, and change nothing; so do limits, and whether an episode finished.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from recrl.agents.actor_critic import ActorCritic, Constraints, indexed, initial_networks
from recrl.agents.advantages import scaled_advantages
from recrl.agents.ascent import ascend, with_entropy
from recrl.agents.batch import LearningBatch
from recrl.agents.config import PPOConfig
from recrl.agents.networks import Adam
from recrl.agents.policies import StochasticPolicy
from recrl.agents.surrogates import SignedAdvantages, clipped_surrogate
from recrl.environments.cmdp import CMDPSpec, Floats


class ProximalPolicyOptimisation:
    """The rule of ``ppo``; a ``recrl.agents.actor_critic.PolicyRule``."""

    def __init__(self, config: PPOConfig, policy: StochasticPolicy) -> None:
        self._config = config
        self._optimiser = Adam(policy.parameters, config.policy_learning_rate)

    def improve(
        self,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> dict[str, float]:
        """Climb the reward's surrogate."""
        rewards, _ = scaled_advantages(advantages, "centred")
        signed = SignedAdvantages.split(batch, rewards)
        gain = partial(clipped_surrogate, advantages=signed, clip=self._config.clip)
        objective = with_entropy(gain, batch, self._config.entropy_bonus)
        metrics = ascend(policy, self._optimiser, batch, advantages, objective=objective, config=self._config)
        return {**metrics, **indexed("multiplier", np.zeros_like(constraints.limits))}

    def state_dict(self) -> dict[str, Any]:
        """The policy's optimiser."""
        return {"optimiser": self._optimiser.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._optimiser.load_state_dict(state["optimiser"])


def make_ppo(cmdp: CMDPSpec, config: PPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh PPO student."""
    policy, critics = initial_networks(cmdp, config, seed)
    return ActorCritic(cmdp, config, policy, critics, ProximalPolicyOptimisation(config, policy))
