"""Penalised proximal policy optimisation (Zhang et al. 2022): an exact penalty instead of multipliers.

The policy takes gradient steps on, in cost per step,

    L_r - kappa sum_i max(0, L_i + c_i),  c_i = (mean episode cost i - limit i) / mean episode length,

with L_r the clipped surrogate of the reward. The surrogate L_i of cost i is *pessimistic*: the mean of
max(ratio A_i, clip(ratio) A_i). The penalty is exact: if kappa exceeds every multiplier of the constrained
problem, both have the same optimum. Nothing is adapted. Advantages and c are, ours, in the units of
``constraints.relative_units``, so that one kappa serves tasks of any units.

Where a limit is kept the penalty has no gradient at first. The first steps follow the reward alone, and one
Adam step may leave the trust region before the penalty acts. So, ours, the change is scaled back to the KL
target_kl: ``trust_region: kept``.

Notation: N samples, D pairs, k costs, j of them can bind.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from recrl.agents.algorithms.own_options import P3OConfig
from recrl.agents.building_blocks.learning_batch import LearningBatch, to_tensor
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.surrogates import SignedAdvantages, clipped_surrogate, pessimistic_relief
from recrl.agents.constraints.relative_units import RelativeConstraints, RelativeUnits
from recrl.agents.experience import Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.gradient_ascent import (
    Objective,
    RadiusRule,
    normalised_by_penalties,
)
from recrl.agents.learning.policy_rule import indexed
from recrl.environments.cmdp import CMDPSpec, Floats


def penalised_surrogate_objective(
    batch: LearningBatch,
    rewards: Floats,
    costs: Floats,
    violations: Floats,
    *,
    clip: float,
    factor: float,
) -> Callable[[Tensor], tuple[Tensor, float]]:
    """Return the module's formula, a function of the ratios, and the sum of the active penalty factors.

    The mean cost advantage of a minibatch is not 0, unlike that of all samples. This is independent of the
    policy, so surrogates of cost are relative to their value at ratios of 1.

    Args:
        batch: the samples.
        rewards: centred advantages, [N].
        costs: centred advantages of the costs that can bind, [N, j].
        violations: c, [j].
        clip: e in (0, 1).
        factor: kappa.
    """
    signed = SignedAdvantages.split(batch, rewards)
    relief = [SignedAdvantages.split(batch, -column) for column in costs.T]
    offsets = to_tensor(violations)

    def surrogate_objective(ratios: Tensor) -> tuple[Tensor, float]:
        excess = torch.relu(offsets - pessimistic_relief(ratios, relief, clip))
        value = clipped_surrogate(ratios, signed, clip) - factor * excess.sum()
        return value, factor * float((excess.detach() > 0.0).sum())

    return surrogate_objective


class PenalisedProximalPolicyOptimisation(RadiusRule[P3OConfig]):
    """The rule of ``p3o``; a ``recrl.agents.learning.policy_rule.PolicyRule``."""

    def __init__(self, config: P3OConfig, policy: StochasticPolicy, num_costs: int) -> None:
        super().__init__(config, policy)
        self._units = RelativeUnits(num_costs)
        self.parts["units"] = self._units

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Ascend the penalised surrogate."""
        config = self._config
        active = RelativeConstraints.of(experience, self._units)

        def objective(part: Experience) -> Objective:
            surrogate_objective = penalised_surrogate_objective(
                part.batch,
                active.rewards,
                active.costs,
                active.violations,
                clip=config.clip,
                factor=config.penalty_factor,
            )
            return normalised_by_penalties(surrogate_objective)

        metrics = self.ascend(policy, experience, objective, generator)
        factors = np.where(active.violations > 0.0, config.penalty_factor, 0.0)
        return {**metrics, **indexed("multiplier", active.in_reward_per_cost(factors))}


def make_p3o(cmdp: CMDPSpec, config: P3OConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new P3O agent."""
    return fresh_agent(
        cmdp, config, seed, lambda policy: PenalisedProximalPolicyOptimisation(config, policy, cmdp.num_costs)
    )
