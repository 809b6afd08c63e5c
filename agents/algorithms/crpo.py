"""Constraint-rectified policy optimisation (Xu, Liang and Lan 2021): no multiplier and no penalty.

If every constraint holds up to a tolerance eta, the policy takes a trust-region step that increases the
reward's surrogate. Otherwise the step decreases the surrogate of a violated cost (algorithm 1). Here this is
the most violated cost in standard deviations of its advantages, so the costs' units do not matter. Costs that
no step can change to first order are passed over. Nothing is carried over to the next update, so a changed
limit takes effect immediately.

Steps of constant length oscillate about the optimum; in the source's proof they are smaller the longer the
run. Here, instead, their length depends on the remaining gain. Symbols are as in
``recrl.agents.trust_region.cpo_dual``, but g is the gradient of the reward, v = H^-1 g, q = g.v, r_i = b_i.v.
With

    p = q - r.nu,  beta = sqrt(p / q) / (2 tau),

    reward step:     sqrt(2 delta / q) v, but at most (min over r_i > 0 of -c_i / r_i, plus beta) v;
    cost step i:     sqrt(2 delta / s) w_i, but at most ((c_i + beta max(r_i, 0)) / s) w_i,  s = S_ii.

p is the squared length of v after projecting out the near constraints, with nu >= 0 from their
complementarity problem. A constraint is near if the trust region reaches its limit. At the optimum p is 0:
the reward's gradient is a combination of the costs' gradients, and a step beyond a limit would be taken back.
Then a cost step corrects the violation and no more, like Polyak's (1967) steps for violated constraints, and
a reward step ends at the limit. Before, steps go as far beyond the limit on one side as on the other. The
coefficient tau is the option ``kl_penalty``, with the unit and the purpose of that of ``trpo-lag``; 0 is the
source's.

Notation: N samples, k costs, of which j have a finite limit.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recrl.agents.algorithms.own_options import CRPOConfig
from recrl.agents.building_blocks.advantages import standardised_advantages
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.experience import ActiveConstraints, Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.policy_rule import Stateful, indexed
from recrl.agents.trust_region.cpo_dual import (
    NO_INFLUENCE,
    DualSolution,
    StepCase,
    StepProblem,
    projection_weights,
)
from recrl.agents.trust_region.line_search import line_search
from recrl.agents.trust_region.local_model import LocalModel, improvement, linearise, to_parameter_step
from recrl.environments.cmdp import CMDPSpec, Floats


def most_violated(
    gaps: Floats, spreads: Floats, tolerance: float, influenced: npt.NDArray[np.bool_]
) -> int | None:
    """Return the cost to decrease, or None if all gaps that a step can change are within the tolerance.

    Args:
        gaps: mean episode cost minus limit, [k]; -inf where there is no constraint.
        spreads: standard deviations of the costs' advantages, [k], above 0.
        tolerance: eta, in episode cost, at least 0.
        influenced: whether a step changes the cost to first order, [k].

    >>> most_violated(np.array([3.0, 2.0, -9.0]), np.array([2.0, 1.0, 1.0]), 0.5, np.full(3, True))
    1
    """
    violated = (gaps > tolerance) & influenced
    if not violated.any():
        return None
    return int(np.argmax(np.where(violated, gaps / spreads, -np.inf)))


def cost_step(problem: StepProblem, corrected: int, config: CRPOConfig) -> DualSolution:
    """Return the module's step that decreases one of the j costs, which a step must be able to change."""
    squared = float(problem.gram[corrected, corrected])
    weights = np.zeros_like(problem.violations)
    weights[corrected] = np.sqrt(2.0 * problem.radius / squared)
    if config.kl_penalty > 0.0:
        beyond = overshoot(problem, config) * max(-float(problem.mixed[corrected]), 0.0)
        weights[corrected] = min(
            weights[corrected], (float(problem.violations[corrected]) + beyond) / squared
        )
    return DualSolution(StepCase.RECOVERY, 0.0, weights, np.full_like(weights, np.nan), (corrected,))


def reward_step(problem: StepProblem, config: CRPOConfig) -> DualSolution:
    """Return the module's step that increases the reward.

    Violations, if any, are within the tolerance, or of costs that no step can change.
    """
    nothing, size = np.zeros_like(problem.violations), 0.0
    if problem.squared_gradient > NO_INFLUENCE:
        size = float(np.sqrt(2.0 * problem.radius / problem.squared_gradient))
        if config.kl_penalty > 0.0:
            rises, slack = -problem.mixed, np.maximum(-problem.violations, 0.0)
            raised = (rises > 0.0) & (np.diag(problem.gram) > NO_INFLUENCE)
            up_to_limit = float(np.min(slack[raised] / rises[raised], initial=np.inf))
            size = min(size, up_to_limit + overshoot(problem, config))
    return DualSolution(StepCase.UNCONSTRAINED, size, nothing, nothing, ())


def overshoot(problem: StepProblem, config: CRPOConfig) -> float:
    """Return beta, the length in units of v by which a step goes beyond a limit; needs a ``kl_penalty``."""
    squared = max(problem.squared_gradient, NO_INFLUENCE)
    at_hand = np.flatnonzero(-problem.violations <= problem.reach)
    rises = -problem.mixed[at_hand]
    weights = projection_weights(problem.gram[np.ix_(at_hand, at_hand)], rises)
    taken = 0.0 if weights is None else float(rises @ weights)
    return float(np.sqrt(max(1.0 - taken / squared, 0.0))) / (2.0 * config.kl_penalty)


class ConstraintRectifiedPolicyOptimisation:
    """The rule of ``crpo``; a ``recrl.agents.learning.policy_rule.PolicyRule``."""

    def __init__(self, config: CRPOConfig) -> None:
        self._config = config
        self.parts: dict[str, Stateful] = {}

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Take one reward step or cost step."""
        constraints = experience.constraints
        config = self._config
        advantages, spreads = standardised_advantages(experience.advantages)
        active = ActiveConstraints.of(constraints).divided_by(spreads[1:])
        model = LocalModel(policy, experience, advantages)
        problem, solved = linearise(model, active, model.metric(config, generator), config)
        influenced = np.full(len(constraints.gaps), False)
        influenced[active.index] = np.diag(problem.gram) > NO_INFLUENCE
        corrected = most_violated(constraints.gaps, spreads[1:], config.tolerance, influenced)
        multipliers = np.zeros_like(constraints.limits)
        if corrected is None:
            solution = reward_step(problem, config)
        else:
            solution = cost_step(problem, int(np.searchsorted(active.index, corrected)), config)
            multipliers[corrected] = np.inf  # as if this were the only constraint; recorded as NaN
        is_acceptable = improvement(model, corrected, config.target_kl)
        metrics = line_search(policy, to_parameter_step(solution, solved), is_acceptable, config)
        return {**metrics, **indexed("multiplier", multipliers)}


def make_crpo(cmdp: CMDPSpec, config: CRPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new CRPO agent."""
    return fresh_agent(cmdp, config, seed, lambda _: ConstraintRectifiedPolicyOptimisation(config))
