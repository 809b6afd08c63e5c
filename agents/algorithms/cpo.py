"""Constrained policy optimisation (Achiam et al. 2017), for any small number of constraints.

Each update takes one trust-region step. Its direction is from ``recrl.agents.trust_region.cpo_dual``. A line
search shortens it until the true surrogates and the true KL agree with the linear model. Advantages are
centred, and each signal's are divided by their standard deviation. Violations per step are divided by the
same numbers, so that b and c have one unit. So the step does not depend on the units of reward and costs.

Costs fall by less than the linear model predicts. So an integral of the violations is added to them, unless
its gain is 0, as in the source (``recrl.agents.constraints.violation_integral``).

While the constrained cost is unknown (a CVaR before the first episode has finished), the policy does not
change. A cost whose limit is infinite is no constraint.

Notation: N samples, k costs, P parameters, delta the trust region's size, H its metric.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.agents.algorithms.own_options import CPOConfig, PCPOConfig
from recrl.agents.constraints.violation_integral import ViolationIntegral
from recrl.agents.errors import require_finite
from recrl.agents.experience import ActiveConstraints, Experience
from recrl.agents.learning.actor_critic import ActorCritic, fresh_agent
from recrl.agents.learning.advantages import standardised_advantages
from recrl.agents.learning.distributions import Distribution, mean_divergence
from recrl.agents.learning.learning_batch import to_tensor
from recrl.agents.learning.policies import FisherMetric, StochasticPolicy
from recrl.agents.learning.policy_rule import Stateful, indexed
from recrl.agents.learning.surrogates import surrogate
from recrl.agents.shared_options import TrustRegionConfig
from recrl.agents.trust_region.conjugate_gradient import conjugate_gradient
from recrl.agents.trust_region.cpo_dual import DualSolution, StepCase, StepProblem, solve_dual
from recrl.agents.trust_region.line_search import line_search
from recrl.environments.cmdp import CMDPSpec, Floats

NAN = float("nan")


class LocalModel:
    """Surrogates and divergence of a changing policy, relative to the policy that collected the samples.

    Args:
        policy: evaluated at its present parameters in each call.
        experience: the samples and the old policy.
        advantages: of the reward, then each cost, [N, 1 + k].
    """

    def __init__(self, policy: StochasticPolicy, experience: Experience, advantages: Floats) -> None:
        self._policy, self._experience = policy, experience
        self._advantages = experience.batch.per_pair(advantages)

    def gradients(self, lowered: Sequence[int] = ()) -> Tensor:
        """Return the gradients of all surrogates at the policy's present parameters, [1 + k, P].

        A standard deviation at its bound is held, so its derivatives are 0, if raising the reward or lowering
        one of some costs would lower it.

        Args:
            lowered: the costs that the step is to lower, indices below k.
        """
        now = self._policy.evaluate(self._experience.batch.unique_observations)
        surrogates = self._surrogates(now.distribution)
        found = torch.stack([now.gradient(each, retain_graph=True).clone() for each in surrogates.unbind()])
        ascents = torch.cat([found[:1], -found[[1 + cost for cost in lowered]]])
        self._policy.hold_bounded_std(found, ascents)
        return found

    def metric(self, config: TrustRegionConfig, generator: np.random.Generator) -> FisherMetric:
        """Return the Hessian of the divergence at the policy's present parameters, plus damping.

        It is evaluated on ``metric_samples`` of the samples, drawn once. With every tenth of 30,000 samples
        the direction has a cosine of 0.998 with the full one and takes a tenth of the time.
        """
        rows, weights = self._experience.batch.thinned(config.metric_samples, generator)
        return FisherMetric(self._policy, rows, weights, config.damping)

    def _surrogates(self, distribution: Distribution) -> Tensor:
        return surrogate(self._experience.ratios(distribution), self._advantages)

    def start(self) -> npt.NDArray[np.floating]:
        """Surrogates of the old policy, [1 + k]."""
        ones = torch.ones_like(self._experience.old_log_probs)
        return surrogate(ones, self._advantages).numpy(force=True)

    def measure(self) -> tuple[npt.NDArray[np.floating], float]:
        """Return the surrogates [1 + k] and the mean KL at the present parameters, in nats."""
        batch = self._experience.batch
        distribution = self._policy.distribution(batch.unique_observations)
        divergence = mean_divergence(self._experience.old, distribution, batch.observation_weights)
        return self._surrogates(distribution).numpy(force=True), float(divergence)


def linearise(
    model: LocalModel, active: ActiveConstraints, metric: FisherMetric, config: TrustRegionConfig
) -> tuple[StepProblem, Tensor]:
    """Return the step's problem reduced to products, and H^-1 g, H^-1 b_1, ..., H^-1 b_j, [1 + j, P]."""
    gradients = model.gradients(lowered=active.index[active.violations > 0.0].tolist())
    chosen = torch.cat([-gradients[:1], gradients[1 + torch.as_tensor(active.index)]])
    solved = torch.stack(
        [conjugate_gradient(metric, each, iterations=config.conjugate_gradient_steps) for each in chosen]
    )
    # The product u.H u for u = H^-1 v, as in safety-starter-agents, not v.u: if conjugate gradients have not
    # converged, this is the true size of the step.
    products = torch.stack([metric(direction) for direction in solved])
    gram = (solved @ products.T).numpy(force=True).astype(np.float64)
    require_finite("products of the trust region's directions", gram)
    gram = 0.5 * (gram + gram.T)
    problem = StepProblem(gram[0, 0], gram[0, 1:], gram[1:, 1:], active.violations, config.target_kl)
    return problem, solved


def to_parameter_step(solution: DualSolution, solved: Tensor) -> Tensor:
    """Return the step x, [P], of a solution; ``solved`` is from ``linearise``."""
    weights = np.concatenate([[solution.gradient_weight], solution.constraint_weights])
    return -to_tensor(weights) @ solved


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
    before = model.start()
    judged = np.ones(len(active.index), dtype=np.bool_)
    if solution.case is StepCase.RECOVERY:
        judged = active.violations <= 0.0
        judged[list(solution.recovered)] = True
    reward_may_fall = bool(np.any(active.violations > 0.0))
    allowed = before[1 + active.index] + np.maximum(-active.violations, 0.0)

    def is_acceptable() -> bool:
        now, divergence = model.measure()
        costs_keep = bool(np.all((now[1 + active.index] <= allowed)[judged]))
        reward_keeps = reward_may_fall or bool(now[0] >= before[0])
        return costs_keep and reward_keeps and divergence <= target_kl

    return is_acceptable


def improvement(model: LocalModel, lowered: int | None, target_kl: float) -> Callable[[], bool]:
    """Return the line search's test of a step on one surrogate: it is not worse, and the KL is within delta.

    Args:
        model: gives surrogates and KL.
        lowered: the cost whose surrogate must not rise; None for the reward's, which must not fall.
        target_kl: delta.
    """
    before = model.start()

    def is_acceptable() -> bool:
        now, divergence = model.measure()
        improved = now[0] >= before[0] if lowered is None else now[1 + lowered] <= before[1 + lowered]
        return bool(improved) and divergence <= target_kl

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
        config: CPOConfig | PCPOConfig,
        num_costs: int,
        solve: Callable[[StepProblem], DualSolution] = solve_dual,
    ) -> None:
        self._config, self._solve = config, solve
        self._integral = ViolationIntegral(config.violation_integral_gain, num_costs)
        self.parts: dict[str, Stateful] = {"violation_integral": self._integral}

    def improve(
        self, policy: StochasticPolicy, experience: Experience, generator: np.random.Generator
    ) -> dict[str, float]:
        """Take one step in the trust region; skip it while the constrained cost is unknown.

        Returns:
            Metrics of the step; ``multiplier_i`` are in standard deviations of the reward's advantages per
            unit of cost, ``violation_integral_i`` in episode cost.
        """
        config, integral, constraints = self._config, self._integral, experience.constraints
        multipliers = np.full_like(constraints.limits, NAN)
        if not constraints.known:
            stayed = {"policy_steps": 0.0, "case": NAN, "line_search_steps": NAN, "step_norm": 0.0}
            return {
                **stayed,
                **indexed("multiplier", multipliers),
                **indexed("violation_integral", multipliers),
            }
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
        multipliers[:] = 0.0
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
