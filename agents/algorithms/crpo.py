"""Constraint-rectified policy optimisation (Xu, Liang and Lan 2021): no multiplier, no penalty, one rule.

Where every constraint holds up to a tolerance eta, the policy takes a trust-region step up the reward's
surrogate; otherwise one down the surrogate of a violated cost (algorithm 1), here the most violated in
standard deviations of its advantages, whatever the costs' units. Nothing is remembered from one update to the
next, so a limit that moves is answered at once.

Steps of one length go to and fro about the optimum by that length for ever; what the source proves is for
steps that shrink as learning goes on. So, ours, they shrink with what is left to be gained (symbols as in
``recrl.agents.trust_region.cpo_dual``, but g is the gradient of the reward, v = H^-1 g, q = g.v, r_i =
b_i.v): with

    p = q - r.nu,  beta = sqrt(p / q) / (2 lambda),

    up the reward:   sqrt(2 delta / q) v, but at most (min over r_i > 0 of -c_i / r_i, plus beta) v;
    down cost i:     sqrt(2 delta / s) w_i, but at most ((c_i + beta max(r_i, 0)) / s) w_i,  s = S_ii.

p is the squared length of what is left of v when the costs at hand are projected out, with nu >= 0 from their
complementarity problem. At the optimum it is 0: the reward pulls against costs and nothing else, and a step
beyond a limit would only be taken back. Then a cost step mends the violation and no more, as Polyak (1967)
steps down a violated constraint, and a reward step ends at the limit. Before, steps go as far beyond the
limit on one side as on the other. A cost is at hand if the trust region reaches its limit. lambda is the
``kl_price``, in the same unit and for the same reason as that of ``trpo-lag``; 0 is the source's.

If no episode finished, nothing is known about the constraints and the policy stays. Notation: N samples, k
costs, of which j have a finite limit.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from recrl.agents.algorithms.cpo import LocalModel, linearise, to_parameter_step
from recrl.agents.algorithms.own_options import CRPOConfig
from recrl.agents.experience import ActiveConstraints, Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.advantages import SMALLEST_STD, reward_spread
from recrl.agents.learning.policies import StochasticPolicy
from recrl.agents.learning.policy_rule import Stateful, indexed
from recrl.agents.trust_region.cpo_dual import (
    NO_INFLUENCE,
    DualSolution,
    StepCase,
    StepProblem,
    projection_weights,
)
from recrl.agents.trust_region.line_search import line_search
from recrl.environments.cmdp import CMDPSpec, Floats


def most_violated(gaps: Floats, spreads: Floats, tolerance: float) -> int | None:
    """The cost to mend, or None if all gaps are within the tolerance.

    Args:
        gaps: mean episode cost minus limit, [k]; -inf where there is no constraint.
        spreads: standard deviations of the costs' advantages, [k], above 0.
        tolerance: eta, in episode cost, at least 0.

    >>> most_violated(np.array([3.0, 2.0, -9.0]), np.array([2.0, 1.0, 1.0]), 0.5)
    1
    """
    violated = gaps > tolerance
    if not violated.any():
        return None
    return int(np.argmax(np.where(violated, gaps / spreads, -np.inf)))


def step_down(problem: StepProblem, mended: int, config: CRPOConfig) -> DualSolution:
    """The module's step down one of the j costs."""
    squared = float(problem.gram[mended, mended])
    weights = np.zeros_like(problem.violations)
    if squared > NO_INFLUENCE:
        weights[mended] = np.sqrt(2.0 * problem.radius / squared)
        if config.kl_price > 0.0:
            beyond = overshoot(problem, config) * max(-float(problem.mixed[mended]), 0.0)
            weights[mended] = min(weights[mended], (float(problem.violations[mended]) + beyond) / squared)
    return DualSolution(StepCase.RECOVERY, 0.0, weights, np.full_like(weights, np.nan), (mended,))


def step_up(problem: StepProblem, config: CRPOConfig) -> DualSolution:
    """The module's step up the reward; violations, if any, are within the tolerance."""
    nothing, size = np.zeros_like(problem.violations), 0.0
    if problem.squared_gradient > NO_INFLUENCE:
        size = float(np.sqrt(2.0 * problem.radius / problem.squared_gradient))
        if config.kl_price > 0.0:
            rises, slack = -problem.mixed, np.maximum(-problem.violations, 0.0)
            raised = rises > 0.0
            up_to_limit = float(np.min(slack[raised] / rises[raised], initial=np.inf))
            size = min(size, up_to_limit + overshoot(problem, config))
    return DualSolution(StepCase.UNCONSTRAINED, size, nothing, nothing, ())


def overshoot(problem: StepProblem, config: CRPOConfig) -> float:
    """beta, how many times v a step goes beyond a limit, with a ``kl_price`` above 0."""
    squared = max(problem.squared_gradient, NO_INFLUENCE)
    reach = np.sqrt(2.0 * problem.radius * np.diag(problem.gram))
    at_hand = np.flatnonzero(-problem.violations <= reach)
    rises = -problem.mixed[at_hand]
    weights = projection_weights(problem.gram[np.ix_(at_hand, at_hand)], rises)
    taken = 0.0 if weights is None else float(rises @ weights)
    return float(np.sqrt(max(1.0 - taken / squared, 0.0))) / (2.0 * config.kl_price)


class ConstraintRectifiedPolicyOptimisation:
    """The rule of ``crpo``; a ``recrl.agents.learning.policy_rule.PolicyRule``."""

    def __init__(self, config: CRPOConfig) -> None:
        self._config = config
        self.parts: dict[str, Stateful] = {}

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Take one step up the reward or down a violated cost, unless nothing is known of the constraints."""
        constraints = experience.constraints
        config = self._config
        if not constraints.known:
            stayed = {"policy_steps": 0.0, "line_search_steps": float("nan"), "step_norm": 0.0}
            return {**stayed, **indexed("multiplier", np.full_like(constraints.limits, np.nan))}
        centred = experience.advantages - experience.advantages.mean(axis=0)
        spreads = np.maximum(centred[:, 1:].std(axis=0), SMALLEST_STD)
        centred[:, 0] /= reward_spread(centred)
        mended = most_violated(constraints.gaps, spreads, config.tolerance)
        active = ActiveConstraints.of(constraints)
        model = LocalModel(policy, experience, centred)
        problem, solved = linearise(model, active, model.metric(config, generator), config)
        multipliers = np.zeros_like(constraints.limits)
        if mended is None:
            solution = step_up(problem, config)
        else:
            solution = step_down(problem, int(np.searchsorted(active.index, mended)), config)
            multipliers[mended] = np.inf  # as if this constraint were all that counts
        is_acceptable = improvement(model, mended, config.target_kl)
        metrics = line_search(policy.parameters, to_parameter_step(solution, solved), is_acceptable, config)
        return {**metrics, **indexed("multiplier", multipliers)}


def improvement(model: LocalModel, mended: int | None, target_kl: float) -> Callable[[], bool]:
    """The line search's test: the KL is within delta, and the reward has not fallen or the cost not risen."""
    before = model.start()

    def is_acceptable() -> bool:
        now, divergence = model.measure()
        improved = now[0] >= before[0] if mended is None else now[1 + mended] <= before[1 + mended]
        return bool(improved) and divergence <= target_kl

    return is_acceptable


def make_crpo(cmdp: CMDPSpec, config: CRPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh CRPO agent."""
    return fresh_agent(cmdp, config, seed, lambda _: ConstraintRectifiedPolicyOptimisation(config))
