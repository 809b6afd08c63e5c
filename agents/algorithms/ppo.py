"""Proximal policy optimisation (Schulman et al. 2017): a control without constraints.

Its objective is the clipped surrogate of the standardised reward advantages. Cost critics are learnt and
costs reported, as with every agent. Neither they nor the limits affect the policy.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from recrl.agents.algorithms.own_options import PPOConfig
from recrl.agents.building_blocks.advantages import standardised_rewards
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.surrogates import SignedAdvantages, clipped_surrogate
from recrl.agents.experience import Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.gradient_ascent import FirstOrderRule, Objective, with_entropy
from recrl.agents.learning.policy_rule import indexed
from recrl.environments.cmdp import CMDPSpec


class ProximalPolicyOptimisation(FirstOrderRule[PPOConfig]):
    """The rule of ``ppo``; a ``recrl.agents.learning.policy_rule.PolicyRule``."""

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Ascend the reward's surrogate."""
        config = self._config
        rewards = standardised_rewards(experience.advantages)

        def objective(part: Experience) -> Objective:
            signed = SignedAdvantages.split(part.batch, rewards)
            surrogate_objective = partial(clipped_surrogate, advantages=signed, clip=config.clip)
            return with_entropy(surrogate_objective, part.batch, config.entropy_bonus)

        metrics = self.ascend(policy, experience, objective, generator)
        return {**metrics, **indexed("multiplier", np.zeros_like(experience.constraints.limits))}


def make_ppo(cmdp: CMDPSpec, config: PPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new PPO agent."""
    return fresh_agent(cmdp, config, seed, lambda policy: ProximalPolicyOptimisation(config, policy))
