"""First-order constrained optimisation in policy space (Zhang, Vuong and Ross 2020, algorithm 1).

The optimal policy near pi_old has a closed form, pi* ~ pi_old exp((A_r - sum_i nu_i A_i) / lam). The network
is fitted to it. Up to constants, this is gradient ascent on

    mean over samples of 1[KL(s) <= delta] (ratio (A_r - sum_i nu_i A_i) / lam - KL(s)),
    KL(s) = KL(pi(. | s) || pi_old(. | s)).

lam, the paper's temperature, is the option ``focops_lambda``, in standard deviations of the reward
advantages. The multipliers nu move by a rule of ``recrl.agents.constraints.multiplier_rules``; the paper's is
projected ascent up to 2. As in ``ppo-lag``, the penalised advantage is divided by 1 + sum_i nu_i, so that a
large multiplier does not make the policy jump. If no constraint binds, lam keeps its meaning.

The source stops once the mean KL exceeds delta, but keeps the last step, and one Adam step may double the KL.
So, ours, the change of the policy in an update is scaled back to the KL delta: ``trust_region: kept``.

Notation: N samples, U rows, D unique pairs, k costs, P parameters.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from recrl.agents.algorithms.own_options import FOCOPSConfig
from recrl.agents.building_blocks.distributions import Distribution
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.constraints.multipliers import Multipliers
from recrl.agents.experience import Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.gradient_ascent import Objective, RadiusRule
from recrl.agents.learning.policy_rule import indexed
from recrl.environments.cmdp import CMDPSpec, Floats


def projection_objective(
    experience: Experience, advantages: Floats, *, focops_lambda: float, radius: float
) -> Objective:
    """Return the objective of the module's formula.

    Args:
        experience: the samples, and pi_old at their rows.
        advantages: of the Lagrangian, of all samples of the rollout, [N].
        focops_lambda: lam, above 0.
        radius: delta, nats; rows with a larger KL have no gradient.
    """
    batch, old = experience.batch, experience.old
    pull = batch.per_pair(advantages / focops_lambda)

    def objective(now: Distribution, ratios: Tensor) -> Tensor:
        assert type(now) is type(old)
        divergence = now.divergence(old)  # type: ignore[arg-type]
        near = (divergence.detach() <= radius).to(divergence.dtype)
        near_decisions = near if batch.pair_observations is None else near[batch.pair_observations]
        return torch.dot(ratios * near_decisions, pull) - torch.dot(
            batch.observation_weights * near, divergence
        )

    return objective


class FirstOrderConstrainedOptimisation(RadiusRule[FOCOPSConfig]):
    """The rule of ``focops``; a ``recrl.agents.learning.policy_rule.PolicyRule``."""

    def __init__(self, config: FOCOPSConfig, policy: StochasticPolicy, num_costs: int) -> None:
        super().__init__(config, policy)
        self._multipliers = Multipliers(config, num_costs)
        self.parts["multipliers"] = self._multipliers

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Move the multipliers, then the policy."""
        config = self._config
        penalty = self._multipliers.update(experience)
        objective = partial(
            projection_objective,
            advantages=penalty.advantages,
            focops_lambda=config.focops_lambda,
            radius=config.target_kl,
        )
        metrics = self.ascend(policy, experience, objective, generator)
        return {**metrics, **indexed("multiplier", penalty.task_multipliers)}


def make_focops(cmdp: CMDPSpec, config: FOCOPSConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new FOCOPS agent."""
    return fresh_agent(
        cmdp, config, seed, lambda policy: FirstOrderConstrainedOptimisation(config, policy, cmdp.num_costs)
    )
