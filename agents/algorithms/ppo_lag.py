"""PPO on the Lagrangian (Ray et al. 2019, section 5).

First the multipliers are updated from the gaps. Then the policy ascends the penalised surrogate, until its
steps are done or the KL is too large.

The objective is (L_r - sum_i p_i L_i) / (1 + sum_i p_i), p the multipliers. ``separate`` clips the reward's
surrogate only (the paper's agents); ``combined`` clips the surrogate of the penalised advantage
A_r - sum_i p_i A_i, so that leaving the clip range to decrease a cost gains nothing either.

Notation: N samples, D unique pairs, k costs.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from torch import Tensor

from recrl.agents.algorithms.own_options import PPOLagConfig
from recrl.agents.building_blocks.advantages import penalised_advantages
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.surrogates import SignedAdvantages, clipped_surrogate, surrogate
from recrl.agents.constraints.multipliers import Multipliers
from recrl.agents.experience import Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.gradient_ascent import FirstOrderRule, Objective, with_entropy
from recrl.agents.learning.policy_rule import indexed
from recrl.environments.cmdp import CMDPSpec, Floats


def combined_surrogate_objective(
    batch: LearningBatch, rewards: Floats, costs: Floats, multipliers: Floats, clip: float
) -> Callable[[Tensor], Tensor]:
    """Return the clipped surrogate of the penalised advantages, as a function of the ratios, [D].

    Args:
        batch: the samples.
        rewards: standardised advantages, [N].
        costs: centred advantages, [N, k].
        multipliers: p, [k].
        clip: e in (0, 1).
    """
    penalised = SignedAdvantages.split(batch, penalised_advantages(rewards, costs, multipliers))
    return lambda ratios: clipped_surrogate(ratios, penalised, clip)


def separate_surrogate_objective(
    batch: LearningBatch, rewards: Floats, costs: Floats, multipliers: Floats, clip: float
) -> Callable[[Tensor], Tensor]:
    """Return the reward's clipped surrogate minus the costs' surrogates times their multipliers.

    The arguments are those of ``combined_surrogate_objective``.
    """
    weight = 1.0 / (1.0 + float(multipliers.sum()))
    signed = SignedAdvantages.split(batch, weight * rewards)
    penalty = batch.per_pair(weight * (costs @ multipliers))
    return lambda ratios: clipped_surrogate(ratios, signed, clip) - surrogate(ratios, penalty)


# By the value of the option ``penalty``.
SURROGATE_OBJECTIVES = {"combined": combined_surrogate_objective, "separate": separate_surrogate_objective}


class PPOLagrangian(FirstOrderRule[PPOLagConfig]):
    """The rule of ``ppo-lag``; a ``recrl.agents.learning.policy_rule.PolicyRule``."""

    def __init__(self, config: PPOLagConfig, policy: StochasticPolicy, num_costs: int) -> None:
        super().__init__(config, policy)
        self._multipliers = Multipliers(config, num_costs)
        self.parts["multipliers"] = self._multipliers

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Move the multipliers, then the policy."""
        config = self._config
        penalty = self._multipliers.update(experience)
        surrogate_objective_of = SURROGATE_OBJECTIVES[config.penalty]

        def objective(part: Experience) -> Objective:
            surrogate_objective = surrogate_objective_of(
                part.batch, penalty.rewards, penalty.costs, penalty.multipliers, config.clip
            )
            return with_entropy(surrogate_objective, part.batch, config.entropy_bonus)

        metrics = self.ascend(policy, experience, objective, generator)
        return {**metrics, **indexed("multiplier", penalty.task_multipliers)}


def make_ppo_lag(cmdp: CMDPSpec, config: PPOLagConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new PPO-Lagrangian agent."""
    return fresh_agent(cmdp, config, seed, lambda policy: PPOLagrangian(config, policy, cmdp.num_costs))
