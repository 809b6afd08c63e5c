"""Trust region policy optimisation (Schulman et al. 2015): a control without constraints.

Each update takes one step, sqrt(2 delta / q) H^-1 g with q = g.H^-1 g (appendix C), as long as the trust
region allows. It is shortened until the surrogate does not fall and the true KL is within delta. ``g`` is the
gradient of a surrogate and H the Hessian of the mean KL plus damping. With no finite limit, ``cpo`` takes the
same step.

Notation: N samples, k costs, P parameters, delta the trust region's size.
"""

from __future__ import annotations

import numpy as np
import torch

from recrl.agents.algorithms.own_options import TRPOConfig
from recrl.agents.building_blocks.advantages import standardised_rewards
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.errors import require_finite
from recrl.agents.experience import Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.policy_rule import Stateful, indexed
from recrl.agents.shared_options import TrustRegionConfig
from recrl.agents.trust_region.conjugate_gradient import conjugate_gradient
from recrl.agents.trust_region.line_search import line_search
from recrl.agents.trust_region.local_model import LocalModel, improvement
from recrl.environments.cmdp import CMDPSpec, Floats


def trust_region_step(
    policy: StochasticPolicy,
    experience: Experience,
    objective: Floats,
    config: TrustRegionConfig,
    generator: np.random.Generator,
    *,
    kl_penalty: float = 0.0,
) -> dict[str, float]:
    """Take one trust-region step on the surrogate of some advantages; skip it if they are all equal.

    With a coefficient tau of the KL it solves max over x of g.x - tau x.H x / 2 within x.H x / 2 <= delta.
    The solution is min(sqrt(2 delta / q), 1 / tau) H^-1 g. It is shorter than the trust region if the gain is
    small.

    Args:
        policy: changed in place.
        experience: the samples.
        objective: the advantages of the surrogate, [N].
        config: the trust region, conjugate gradients and line search.
        generator: for the choice of the metric's samples.
        kl_penalty: tau, the coefficient of the KL, in the advantages' unit per nat, at least 0.

    Returns:
        Metrics of the step.
    """
    model = LocalModel(policy, experience, objective[:, None])
    metric = model.metric(config, generator)
    gradient = model.gradients()[0]
    direction = conjugate_gradient(metric, gradient, iterations=config.conjugate_gradient_steps)
    squared = float(torch.dot(direction, metric(direction)))
    require_finite("the squared length of the trust region's direction", squared)
    if squared <= 0.0:
        return {"policy_steps": 0.0, "line_search_steps": float(config.backtrack_tries), "step_norm": 0.0}
    direction.mul_(step_size(squared, config.target_kl, kl_penalty))
    return line_search(policy, direction, improvement(model, None, config.target_kl), config)


def step_size(squared: float, target_kl: float, kl_penalty: float) -> float:
    """Return the factor on H^-1 g: min(sqrt(2 delta / q), 1 / tau).

    Args:
        squared: q, above 0.
        target_kl: delta, nats.
        kl_penalty: tau, at least 0.

    >>> step_size(8.0, 0.01, 0.0), step_size(8.0, 0.01, 10.0), step_size(8.0, 0.01, 40.0)
    (0.05, 0.05, 0.025)
    """
    longest: float = (2.0 * target_kl / squared) ** 0.5
    return longest if kl_penalty * longest <= 1.0 else 1.0 / kl_penalty


class TrustRegionPolicyOptimisation:
    """The rule of ``trpo``; a ``recrl.agents.learning.policy_rule.PolicyRule``."""

    def __init__(self, config: TRPOConfig) -> None:
        self._config = config
        self.parts: dict[str, Stateful] = {}

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Take one step on the reward's surrogate."""
        rewards = standardised_rewards(experience.advantages)
        metrics = trust_region_step(policy, experience, rewards, self._config, generator)
        return {**metrics, **indexed("multiplier", np.zeros_like(experience.constraints.limits))}


def make_trpo(cmdp: CMDPSpec, config: TRPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new TRPO agent."""
    return fresh_agent(cmdp, config, seed, lambda _: TrustRegionPolicyOptimisation(config))
