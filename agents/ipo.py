"""Interior-point policy optimisation (Liu, Ding and Liu 2020): a logarithmic barrier before each limit.

The policy climbs, in cost per step,

    L_r + sum_i phi(s_i),  s_i = -(L_i + c_i),  c_i = (mean episode cost i - limit i) / mean episode length,

with L_r the clipped surrogate of the reward, L_i the surrogate of cost i, and phi(s) = log(s) / t. The
optimum gives away 1 / t of reward a step for each constraint that binds. The paper leaves open what happens
where there is no slack: there phi goes on along its tangent (Kervadec et al. 2022), from the slack
1 / (t kappa) at which its slope is kappa,

    phi(s) = log(s) / t                                if s >= 1 / (t kappa),
             kappa s - (1 + log(t kappa)) / t          otherwise,

so that a violated constraint is an exact penalty with the factor kappa. All advantages and c are in standard
deviations of the reward's advantages, so that kappa is in reward per unit of cost, as multipliers are.

If no episode finished, nothing is known about the constraints and the policy stays. Letters: N samples, D
decisions, k costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.agents.actor_critic import ActorCritic, Constraints, indexed, initial_networks
from recrl.agents.advantages import reward_spread, scaled_advantages
from recrl.agents.ascent import ascend, with_prices
from recrl.agents.batch import LearningBatch, to_tensor
from recrl.agents.config import IPOConfig
from recrl.agents.cpo import ActiveConstraints
from recrl.agents.networks import Adam
from recrl.agents.policies import StochasticPolicy
from recrl.agents.surrogates import SignedAdvantages, clipped_surrogate, surrogate
from recrl.environments.cmdp import CMDPSpec, Floats


def barrier(slack: Tensor, *, sharpness: float, slope: float) -> Tensor:
    """The barrier phi of each slack, any shape; ``sharpness`` is t and ``slope`` is kappa."""
    edge = 1.0 / (sharpness * slope)
    inside = torch.log(slack.clamp(min=edge)) / sharpness
    return inside + slope * (slack - edge).clamp(max=0.0)


def slopes(slack: npt.NDArray[np.floating], config: IPOConfig) -> Floats:
    """The derivatives of the barriers, what they charge for cost: 1 / (t s), or kappa without that slack."""
    edge = 1.0 / (config.barrier_sharpness * config.barrier_slope)
    charged = 1.0 / (config.barrier_sharpness * np.maximum(slack, edge))
    return np.asarray(charged, dtype=np.float64)


def barrier_gain(
    batch: LearningBatch, advantages: Floats, active: ActiveConstraints, config: IPOConfig
) -> Callable[[Tensor], tuple[Tensor, float]]:
    """The module's formula, a function of the ratios, with the sum of the barriers' slopes.

    Args:
        batch: the collapsed samples.
        advantages: raw, [N, 1 + k].
        active: the constraints that have a limit.
        config: clip, t and kappa.
    """
    rewards, costs = scaled_advantages(advantages, "reward-scaled")
    signed = SignedAdvantages.split(batch, rewards)
    per_decision = batch.per_decision(costs)[:, torch.from_numpy(active.index)]
    violations = to_tensor(active.violations / reward_spread(advantages))
    shape = partial(barrier, sharpness=config.barrier_sharpness, slope=config.barrier_slope)

    def gain(ratios: Tensor) -> tuple[Tensor, float]:
        slack = -(surrogate(ratios, per_decision) + violations)
        charged = slopes(slack.detach().numpy(), config)
        return clipped_surrogate(ratios, signed, config.clip) + shape(slack).sum(), float(charged.sum())

    return gain


class InteriorPointPolicyOptimisation:
    """The rule of ``ipo``; a ``recrl.agents.actor_critic.PolicyRule``."""

    def __init__(self, config: IPOConfig, policy: StochasticPolicy) -> None:
        self._config = config
        self._optimiser = Adam(policy.parameters, config.policy_learning_rate)

    def improve(
        self,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> dict[str, float]:
        """Climb the surrogate between the barriers, unless nothing is known about the constraints."""
        config = self._config
        objective = None
        multipliers = np.full_like(constraints.limits, np.nan)
        if constraints.known:
            active = ActiveConstraints.of(constraints)
            objective = with_prices(barrier_gain(batch, advantages, active, config))
            multipliers = np.zeros_like(constraints.limits)
            multipliers[active.index] = slopes(-active.violations / reward_spread(advantages), config)
        metrics = ascend(policy, self._optimiser, batch, advantages, objective=objective, config=config)
        return {**metrics, **indexed("multiplier", multipliers)}

    def state_dict(self) -> dict[str, Any]:
        """The policy's optimiser."""
        return {"optimiser": self._optimiser.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._optimiser.load_state_dict(state["optimiser"])


def make_ipo(cmdp: CMDPSpec, config: IPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh IPO student."""
    policy, critics = initial_networks(cmdp, config, seed)
    return ActorCritic(cmdp, config, policy, critics, InteriorPointPolicyOptimisation(config, policy))
