"""Constrained policy optimisation (Achiam et al. 2017), for any small number of constraints.

Each update takes one trust-region step. Its direction is from ``recrl.agents.trust_region.cpo_dual``. A line
search shortens it until the true surrogates and the true KL agree with the linear model. Advantages are
centred, and each signal's are divided by their standard deviation. Violations per step are divided by the
same numbers, so that b and c have one unit. So the step does not depend on the units of reward and costs.

Costs fall by less than the linear model predicts. So an integral of the violations is added to them, unless
its gain is 0, as in the source (``recrl.agents.constraints.violation_integral``).

A cost whose limit is infinite is no constraint.

Notation: N samples, k costs, P parameters, delta the trust region's size, H its metric.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from recrl.agents.algorithms.own_options import CPOConfig
from recrl.agents.building_blocks.advantages import standardised_advantages
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.constraints.violation_integral import ViolationIntegral
from recrl.agents.experience import ActiveConstraints, Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.policy_rule import Stateful, indexed
from recrl.agents.trust_region.cpo_dual import DualSolution, StepCase, StepProblem, solve_dual
from recrl.agents.trust_region.line_search import line_search
from recrl.agents.trust_region.local_model import LocalModel, linearise, to_parameter_step
from recrl.environments.cmdp import CMDPSpec


def acceptance(
    model: LocalModel, active: ActiveConstraints, solution: DualSolution, target_kl: float
) -> Callable[[], bool]:
    """Return the line search's test of the policy at its present parameters.

    The KL is within delta; cost surrogate i rises by at most max(-c_i, 0). The reward surrogate does not
    fall, unless a constraint is violated. In recovery only the recovered costs and the costs within their
    limits are checked: contradicting constraints cannot all improve at once.

    Args:
        model: gives surrogates and KL.
        active: the constraints.
        solution: the solved step.
        target_kl: delta.
    """
    before = model.old_surrogates()
    checked = np.ones(len(active.index), dtype=np.bool_)
    if solution.case is StepCase.RECOVERY:
        checked = active.violations <= 0.0
        checked[list(solution.recovered)] = True
    reward_may_fall = bool(np.any(active.violations > 0.0))
    allowed = before[1 + active.index] + np.maximum(-active.violations, 0.0)

    def is_acceptable() -> bool:
        now, divergence = model.surrogates_and_divergence()
        costs_keep = bool(np.all((now[1 + active.index] <= allowed)[checked]))
        reward_keeps = reward_may_fall or bool(now[0] >= before[0])
        return costs_keep and reward_keeps and divergence <= target_kl

    return is_acceptable


class ConstrainedPolicyOptimisation:
    """The rule of ``cpo`` and ``pcpo``; a ``recrl.agents.learning.policy_rule.PolicyRule``.

    Args:
        config: the agent's settings.
        num_costs: k.
        solve: gives the step of the linear and quadratic model; ``solve_dual`` is CPO's.
    """

    def __init__(
        self,
        config: CPOConfig,
        num_costs: int,
        solve: Callable[[StepProblem], DualSolution] = solve_dual,
    ) -> None:
        self._config, self._solve = config, solve
        self._integral = ViolationIntegral(config.violation_integral_gain, num_costs)
        self.parts: dict[str, Stateful] = {"violation_integral": self._integral}

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Take one step in the trust region.

        Returns:
            Metrics of the step; ``multiplier_i`` are in standard deviations of the reward's advantages per
            unit of cost, ``violation_integral_i`` in episode cost.
        """
        config, integral, constraints = self._config, self._integral, experience.constraints
        advantages, spreads = standardised_advantages(experience.advantages)
        model = LocalModel(policy, experience, advantages)
        active = ActiveConstraints.of(integral.corrected(constraints)).divided_by(spreads[1:])
        metric = model.metric(config, generator)
        problem, solved = linearise(model, active, metric, config)
        solution = self._solve(problem)
        is_acceptable = acceptance(model, active, solution, config.target_kl)
        metrics = line_search(policy, to_parameter_step(solution, solved), is_acceptable, config)
        reach = problem.reach * spreads[1 + active.index] * constraints.episode_length
        integral.bound(active.index, constraints.limits[active.index], reach)
        multipliers = np.zeros_like(constraints.limits)
        multipliers[active.index] = solution.multipliers / spreads[1 + active.index]
        return {
            **metrics,
            "case": float(solution.case),
            **indexed("multiplier", multipliers),
            **indexed("violation_integral", integral.values),
        }


def make_cpo(cmdp: CMDPSpec, config: CPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """Make a new CPO agent."""
    return fresh_agent(cmdp, config, seed, lambda _: ConstrainedPolicyOptimisation(config, cmdp.num_costs))
