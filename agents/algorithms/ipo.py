"""Interior-point policy optimisation (Liu, Ding and Liu 2020): a logarithmic barrier before each limit.

The policy takes gradient steps on, in cost per step,

    L_r + sum_i phi(s_i),  s_i = -(L_i + c_i),  c_i = (mean episode cost i - limit i) / mean episode length,

with L_r the clipped surrogate of the reward, L_i that of cost i, and phi(s) = log(s) / t. L_i is, ours, the
*pessimistic* surrogate of ``p3o``. The source's plain surrogate extrapolates a decrease of cost that holds
only locally. So a violated constraint moves the policy too far in one update (on a RiverGrid, to one goal
permanently). At the optimum each binding constraint costs 1 / t
standard deviations of the reward's advantages a step. The paper does not define
phi without slack. Here it continues along its tangent (Kervadec et al. 2022), from the slack 1 / (t kappa) at
which its slope is kappa,

    phi(s) = log(s) / t                                if s >= 1 / (t kappa),
             kappa s - (1 + log(t kappa)) / t          otherwise,

so that a violated constraint is an exact penalty with the factor kappa. Advantages and c are in the units of
``constraints.relative_units``, so that one kappa serves tasks of any units.

Notation: N samples, D pairs, k costs, j of them can bind.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.agents.algorithms.own_options import IPOConfig
from recrl.agents.building_blocks.learning_batch import LearningBatch, to_tensor
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.surrogates import (
    SignedAdvantages,
    clipped_surrogate,
    pessimistic_relief,
    surrogate,
)
from recrl.agents.constraints.relative_units import RelativeConstraints, RelativeUnits
from recrl.agents.experience import Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.gradient_ascent import (
    FirstOrderRule,
    Objective,
    normalised_by_penalties,
)
from recrl.agents.learning.policy_rule import indexed
from recrl.environments.cmdp import CMDPSpec, Floats


def barrier(slack: Tensor, *, sharpness: float, slope: float) -> Tensor:
    """Return the barrier phi of each slack, in its shape; ``sharpness`` is t and ``slope`` is kappa."""
    edge = 1.0 / (sharpness * slope)
    inside = torch.log(slack.clamp(min=edge)) / sharpness
    return inside + slope * (slack - edge).clamp(max=0.0)


def slopes(slack: npt.NDArray[np.floating], config: IPOConfig) -> Floats:
    """Return the barriers' derivatives at slacks s, [j], the weights of costs: 1 / (t s), or kappa; [j]."""
    edge = 1.0 / (config.barrier_sharpness * config.barrier_slope)
    charged = 1.0 / (config.barrier_sharpness * np.maximum(slack, edge))
    return np.asarray(charged, dtype=np.float64)


def relief_of(batch: LearningBatch, costs: Floats, config: IPOConfig) -> Callable[[Tensor], Tensor]:
    """Return a function of the ratios, [D] -> [j]: -L_i, the decrease of the cost surrogates, [N, j]."""
    if config.cost_surrogate == "pessimistic":
        split = [SignedAdvantages.split(batch, -column) for column in costs.T]
        return partial(pessimistic_relief, relief=split, clip=config.clip)
    per_pair = batch.per_pair(-costs)
    return lambda ratios: surrogate(ratios - 1.0, per_pair)


def barrier_surrogate_objective(
    batch: LearningBatch, rewards: Floats, costs: Floats, violations: Floats, config: IPOConfig
) -> Callable[[Tensor], tuple[Tensor, float]]:
    """Return the module's formula, a function of the ratios, and the sum of the barriers' slopes.

    The mean cost advantage of a minibatch is not 0, unlike that of all samples. This is independent of the
    policy, so surrogates of cost are relative to their value at ratios of 1.

    Args:
        batch: the samples.
        rewards: centred advantages, [N].
        costs: centred advantages of the costs that can bind, [N, j].
        violations: c, [j].
        config: clip, cost_surrogate, t and kappa.
    """
    signed = SignedAdvantages.split(batch, rewards)
    offsets = to_tensor(violations)
    shape = partial(barrier, sharpness=config.barrier_sharpness, slope=config.barrier_slope)
    relief = relief_of(batch, costs, config)

    def surrogate_objective(ratios: Tensor) -> tuple[Tensor, float]:
        slack = relief(ratios) - offsets
        charged = slopes(slack.detach().numpy(force=True), config)
        return clipped_surrogate(ratios, signed, config.clip) + shape(slack).sum(), float(charged.sum())

    return surrogate_objective


class InteriorPointPolicyOptimisation(FirstOrderRule[IPOConfig]):
    """The rule of ``ipo``; a ``recrl.agents.learning.policy_rule.PolicyRule``."""

    def __init__(self, config: IPOConfig, policy: StochasticPolicy, num_costs: int) -> None:
        super().__init__(config, policy)
        self._units = RelativeUnits(num_costs)
        self.parts["units"] = self._units

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Ascend the surrogate with barriers."""
        config = self._config
        active = RelativeConstraints.of(experience, self._units)

        def objective(part: Experience) -> Objective:
            return normalised_by_penalties(
                barrier_surrogate_objective(
                    part.batch, active.rewards, active.costs, active.violations, config
                )
            )

        metrics = self.ascend(policy, experience, objective, generator)
        multipliers = active.in_reward_per_cost(slopes(-active.violations, config))
        return {**metrics, **indexed("multiplier", multipliers)}


def make_ipo(cmdp: CMDPSpec, config: IPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new IPO agent."""
    return fresh_agent(
        cmdp, config, seed, lambda policy: InteriorPointPolicyOptimisation(config, policy, cmdp.num_costs)
    )
