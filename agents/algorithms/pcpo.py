"""Projection-based constrained policy optimisation (Yang et al. 2020), for any small number of constraints.

First the step that improves the reward, y = -sqrt(2 delta / q) v, then its projection, in the metric H, onto
the set where the linearised constraints hold (symbols as in ``recrl.agents.trust_region.cpo_dual``):

    minimise (x - y).H (x - y) / 2  subject to  b_i.x + c_i <= 0 for i = 1..k.

The optimum is x = y - sum_i nu_i w_i, where nu >= 0 solves the complementarity problem

    e - S nu <= 0,  nu.(e - S nu) = 0,    e = c - sqrt(2 delta / q) r  (the excesses b_i.y + c_i of y);

for k = 1, nu = max(0, e) / S, as in the paper. The projection of a policy far from feasible is a long step.
The paper bounds the damage; here the step is scaled back into the trust region. Then ``cpo``'s line search
shortens it, which the paper does not do.

Notation: N samples, k costs, P parameters.
"""

from __future__ import annotations

import numpy as np

from recrl.agents.algorithms.cpo import ConstrainedPolicyOptimisation
from recrl.agents.algorithms.own_options import PCPOConfig
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.trust_region.cpo_dual import (
    NO_INFLUENCE,
    DualSolution,
    StepCase,
    StepProblem,
    projection_weights,
    worst_alone,
)
from recrl.environments.cmdp import CMDPSpec


def projected_step(problem: StepProblem) -> DualSolution:
    """Return the reward's step, projected and scaled back into the trust region.

    If the constraints contradict one another, it projects on one only: the most violated
    of those that the policy can influence. Then the others need not improve (``StepCase.RECOVERY``).
    """
    squared = problem.squared_gradient
    reach = float(np.sqrt(2.0 * problem.radius / squared)) if squared > NO_INFLUENCE else 0.0
    excesses = problem.violations - reach * problem.mixed
    weights = projection_weights(problem.gram, excesses)
    recovered: tuple[int, ...] = ()
    if weights is None:
        worst = worst_alone(problem.gram, excesses)
        weights = np.zeros_like(excesses)
        weights[worst] = excesses[worst] / problem.gram[worst, worst]
        recovered = (worst,)
    length = (
        reach**2 * squared
        + 2.0 * reach * float(weights @ problem.mixed)
        + float(weights @ problem.gram @ weights)
    )
    scale = min(1.0, float(np.sqrt(2.0 * problem.radius / max(length, NO_INFLUENCE))))
    unknown = np.full_like(weights, np.nan)
    if recovered:
        return DualSolution(StepCase.RECOVERY, scale * reach, scale * weights, unknown, recovered)
    case = StepCase.CONSTRAINED if weights.any() else StepCase.UNCONSTRAINED
    multipliers = weights / reach if reach > 0.0 else unknown
    return DualSolution(case, scale * reach, scale * weights, multipliers, ())


def make_pcpo(cmdp: CMDPSpec, config: PCPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new PCPO agent."""
    rule = ConstrainedPolicyOptimisation(config, cmdp.num_costs, projected_step)
    return fresh_agent(cmdp, config, seed, lambda _: rule)
