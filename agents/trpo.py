"""Trust region policy optimisation (Schulman et al. 2015): the control that knows no constraint.

One step an update, along H^-1 g and as long as the trust region allows, sqrt(2 delta / q) H^-1 g with
q = g.H^-1 g (appendix C), shortened until the surrogate does not fall and the true KL is within delta. ``g``
is the gradient of a surrogate and H the Hessian of the mean KL plus damping. With no finite limit, ``cpo``
takes the same step.

Letters: N samples, k costs, P parameters, delta the trust region's size.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from recrl.agents.actor_critic import ActorCritic, Constraints, indexed, initial_networks
from recrl.agents.advantages import scaled_advantages
from recrl.agents.batch import LearningBatch
from recrl.agents.config import TRPOConfig, TrustRegionConfig
from recrl.agents.cpo import LocalModel
from recrl.agents.errors import require_finite
from recrl.agents.policies import StochasticPolicy
from recrl.agents.trust_region import backtrack, conjugate_gradient
from recrl.environments.cmdp import CMDPSpec, Floats


def step_up(
    policy: StochasticPolicy, batch: LearningBatch, objective: Floats, config: TrustRegionConfig
) -> tuple[int | None, float]:
    """Take one trust-region step up the surrogate of some advantages.

    Args:
        policy: changed in place.
        batch: the collapsed samples.
        objective: the advantages, [N].
        config: the trust region, conjugate gradients and line search.

    Returns:
        How often the step was shortened, or None if the policy stays, and the length of the step taken.
    """
    model = LocalModel(policy, batch, objective[:, None])
    metric = model.metric(config.damping)
    gradient = model.gradients()[0]
    direction = conjugate_gradient(metric, gradient, iterations=config.conjugate_gradient_steps)
    squared = float(torch.dot(direction, metric(direction)))
    require_finite("the squared length of the trust region's direction", squared)
    if squared <= 0.0:
        return None, 0.0
    direction.mul_((2.0 * config.target_kl / squared) ** 0.5)
    before, _ = model.measure()

    def is_acceptable() -> bool:
        now, divergence = model.measure()
        return bool(now[0] >= before[0]) and divergence <= config.target_kl

    shortened = backtrack(
        policy.parameters,
        direction,
        is_acceptable,
        ratio=config.backtrack_ratio,
        tries=config.backtrack_tries,
    )
    taken = 0.0 if shortened is None else config.backtrack_ratio**shortened
    return shortened, taken * float(direction.norm())


def improve_within_trust_region(
    policy: StochasticPolicy,
    batch: LearningBatch,
    advantages: Floats,
    *,
    objective: Floats | None,
    config: TrustRegionConfig,
) -> dict[str, float]:
    """``step_up``, or stay where ``objective`` is None; what it brought, as metrics.

    Args:
        policy: changed in place.
        batch: the collapsed samples.
        advantages: raw, [N, 1 + k]; the metrics ``surrogate_reward`` and ``surrogate_cost_i`` are in their
            units.
        objective: the advantages to climb, [N].
        config: how far.
    """
    gains = LocalModel(policy, batch, advantages - advantages.mean(axis=0))
    shortened, norm = None, 0.0
    if objective is not None:
        shortened, norm = step_up(policy, batch, objective, config)
    surrogates, _ = gains.measure()
    return {
        "policy_steps": float(shortened is not None),
        "line_search_steps": float(config.backtrack_tries if shortened is None else shortened),
        "step_norm": norm,
        "surrogate_reward": float(surrogates[0]),
        **indexed("surrogate_cost", surrogates[1:]),
    }


class TrustRegionPolicyOptimisation:
    """The rule of ``trpo``; a ``recrl.agents.actor_critic.PolicyRule``. It keeps no state."""

    def __init__(self, config: TRPOConfig) -> None:
        self._config = config

    def improve(
        self,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> dict[str, float]:
        """Take one step up the reward's surrogate."""
        rewards, _ = scaled_advantages(advantages, "centred")
        metrics = improve_within_trust_region(
            policy, batch, advantages, objective=rewards, config=self._config
        )
        return {**metrics, **indexed("multiplier", np.zeros_like(constraints.limits))}

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Nothing to load."""


def make_trpo(cmdp: CMDPSpec, config: TRPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh TRPO student."""
    policy, critics = initial_networks(cmdp, config, seed)
    return ActorCritic(cmdp, config, policy, critics, TrustRegionPolicyOptimisation(config))
