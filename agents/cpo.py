"""Constrained policy optimisation (Achiam et al. 2017), for any small number of constraints.

One trust-region step an update: the direction from ``recrl.agents.cpo_dual``, shortened by a line search
until the true surrogates and the true KL agree with the linear model. Cost advantages are centred and not
scaled, and the constraints enter in cost per step, so that b and c have one unit.

If no episode finished, nothing is known about the constraints and the policy stays. A cost whose limit is
infinite is no constraint.

Letters: N samples, k costs, P parameters, delta the trust region's size, H its metric.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.agents.actor_critic import ActorCritic, Constraints, indexed, initial_networks
from recrl.agents.batch import LearningBatch
from recrl.agents.config import CPOConfig, TrustRegionConfig
from recrl.agents.cpo_dual import DualSolution, StepCase, StepProblem, solve_dual
from recrl.agents.distributions import Distribution, mean_divergence
from recrl.agents.errors import require_finite
from recrl.agents.policies import FisherMetric, StochasticPolicy
from recrl.agents.surrogates import surrogate
from recrl.agents.trust_region import backtrack, conjugate_gradient
from recrl.environments.cmdp import CMDPSpec, Floats

SMALLEST_STD = 1e-8
NAN = float("nan")


class LocalModel:
    """Surrogates and divergence of a policy that moves away from the one that collected the samples.

    Args:
        policy: judged at its present parameters, whatever they are when asked.
        batch: the collapsed samples.
        advantages: of the reward, then each cost, [N, 1 + k].
    """

    def __init__(self, policy: StochasticPolicy, batch: LearningBatch, advantages: Floats) -> None:
        self._policy, self._batch = policy, batch
        self._advantages = batch.per_decision(advantages)
        self._old = policy.distribution(batch.rows)
        self._old_log_probs = self._old.log_prob(batch.actions, batch.decision_rows)

    def gradients(self) -> Tensor:
        """The gradients of all surrogates at the policy as it is now, [1 + k, P]."""
        now = self._policy.evaluate(self._batch.rows)
        surrogates = self._surrogates(now.distribution)
        return torch.stack([now.gradient(each, retain_graph=True).clone() for each in surrogates.unbind()])

    def metric(self, damping: float) -> FisherMetric:
        """The Hessian of the divergence at the policy as it is now, plus ``damping``."""
        return FisherMetric(self._policy, self._batch.rows, self._batch.row_weights, damping)

    def _surrogates(self, distribution: Distribution) -> Tensor:
        log_probs = distribution.log_prob(self._batch.actions, self._batch.decision_rows)
        return surrogate(torch.exp(log_probs - self._old_log_probs), self._advantages)

    def measure(self) -> tuple[npt.NDArray[np.float32], float]:
        """Surrogates [1 + k] and mean KL of the policy as it is now, in nats."""
        distribution = self._policy.distribution(self._batch.rows)
        divergence = mean_divergence(self._old, distribution, self._batch.row_weights)
        return self._surrogates(distribution).numpy(), float(divergence)


@dataclass(frozen=True, eq=False)
class ActiveConstraints:
    """The constraints whose limits are finite, j of k.

    Attributes:
        index: which they are, [j].
        violations: c, (mean episode cost - limit) / mean episode length, [j].
    """

    index: npt.NDArray[np.int64]
    violations: Floats

    @classmethod
    def of(cls, constraints: Constraints) -> ActiveConstraints:
        """Those of ``constraints``, in the unit of the surrogates: cost per step."""
        index = np.flatnonzero(np.isfinite(constraints.limits))
        return cls(index, constraints.gaps[index] / constraints.episode_length)


class ConstrainedPolicyOptimisation:
    """The rule of ``cpo``; a ``recrl.agents.actor_critic.PolicyRule``. It keeps no state."""

    def __init__(self, config: CPOConfig) -> None:
        self._config = config

    def improve(
        self,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> dict[str, float]:
        """Take one constrained trust-region step, unless nothing is known about the constraints."""
        centred = advantages - advantages.mean(axis=0)
        std = max(float(centred[:, 0].std()), SMALLEST_STD)
        centred[:, 0] /= std  # changes no step, only the unit of the multipliers
        model = LocalModel(policy, batch, centred)
        multipliers = np.full_like(constraints.limits, NAN)
        metrics = {"policy_steps": 0.0, "case": NAN, "line_search_steps": NAN, "step_norm": 0.0}
        if constraints.known:
            active = ActiveConstraints.of(constraints)
            step, solution = self._direction(model, active)
            shortened = backtrack(
                policy.parameters,
                step,
                acceptance(model, active, solution, self._config.target_kl),
                ratio=self._config.backtrack_ratio,
                tries=self._config.backtrack_tries,
            )
            taken = 0.0 if shortened is None else self._config.backtrack_ratio**shortened
            multipliers = np.zeros_like(constraints.limits)
            multipliers[active.index] = solution.multipliers
            metrics = {
                "policy_steps": float(shortened is not None),
                "case": float(solution.case),
                "line_search_steps": float(self._config.backtrack_tries if shortened is None else shortened),
                "step_norm": taken * float(step.norm()),
            }
        gains, _ = model.measure()
        return {
            **metrics,
            "surrogate_reward": float(gains[0]) * std,
            **indexed("surrogate_cost", gains[1:]),
            **indexed("multiplier", multipliers),
        }

    def _direction(self, model: LocalModel, active: ActiveConstraints) -> tuple[Tensor, DualSolution]:
        """The full step x, [P], of the linearised problem, and its solution."""
        problem, solved = linearise(model, active, self._config)
        solution = solve_dual(problem)
        return along(solution, solved), solution

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Nothing to load."""


def linearise(
    model: LocalModel, active: ActiveConstraints, config: TrustRegionConfig
) -> tuple[StepProblem, Tensor]:
    """The step's problem reduced to products, and H^-1 g, H^-1 b_1, ..., H^-1 b_j, [1 + j, P].

    The products are v.H v for q and so on, as safety-starter-agents takes them, not g.v: where conjugate
    gradients have not converged, that is the true size of the step.
    """
    gradients = model.gradients()
    metric = model.metric(config.damping)
    chosen = torch.cat([-gradients[:1], gradients[1 + torch.from_numpy(active.index)]])
    solved = torch.stack(
        [conjugate_gradient(metric, each, iterations=config.conjugate_gradient_steps) for each in chosen]
    )
    products = torch.stack([metric(direction) for direction in solved])
    gram = (solved @ products.T).numpy().astype(np.float64)
    require_finite("products of the trust region's directions", gram)
    gram = 0.5 * (gram + gram.T)
    problem = StepProblem(gram[0, 0], gram[0, 1:], gram[1:, 1:], active.violations, config.target_kl)
    return problem, solved


def along(solution: DualSolution, solved: Tensor) -> Tensor:
    """The step x, [P], that a solution stands for; ``solved`` is as ``linearise`` gives it."""
    weights = np.concatenate([[solution.gradient_weight], solution.constraint_weights])
    return -torch.from_numpy(weights.astype(np.float32)) @ solved


def acceptance(
    model: LocalModel, active: ActiveConstraints, solution: DualSolution, target_kl: float
) -> Callable[[], bool]:
    """The line search's test of the policy as it is when asked.

    The KL is within delta; cost surrogate i rises by at most max(-c_i, 0); and the reward surrogate does not
    fall, unless a constraint is violated. In recovery only the cost that is recovered and those within
    their limits are judged: the other violated ones may have to wait.

    Args:
        model: asked for surrogates and KL.
        active: the constraints.
        solution: what the step solves.
        target_kl: delta.
    """
    before, _ = model.measure()
    judged = np.ones(len(active.index), dtype=np.bool_)
    if solution.case is StepCase.RECOVERY:
        judged = active.violations <= 0.0
        judged[solution.recovered] = True
    reward_may_fall = bool(np.any(active.violations > 0.0))
    allowed = before[1 + active.index] + np.maximum(-active.violations, 0.0)

    def is_acceptable() -> bool:
        now, divergence = model.measure()
        costs_keep = bool(np.all((now[1 + active.index] <= allowed)[judged]))
        reward_keeps = reward_may_fall or bool(now[0] >= before[0])
        return costs_keep and reward_keeps and divergence <= target_kl

    return is_acceptable


def make_cpo(cmdp: CMDPSpec, config: CPOConfig, seed: np.random.SeedSequence) -> ActorCritic:
    """A fresh CPO student."""
    policy, critics = initial_networks(cmdp, config, seed)
    return ActorCritic(cmdp, config, policy, critics, ConstrainedPolicyOptimisation(config))
