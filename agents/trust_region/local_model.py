"""A trust region's local model of the objective and constraints, and the step's problem that follows from it.

The model is linear in the surrogates and quadratic in the divergence, about the policy that collected the
samples. ``linearise`` reduces it to the products that a step is computed from. ``improvement`` is a line
search's test of a step on one surrogate.

Notation: N samples, k costs, of which j have a finite limit; P parameters; delta the trust region's size; H
its metric; g the gradient of the objective, b_i those of the constraints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.agents.building_blocks.distributions import Distribution, mean_divergence
from recrl.agents.building_blocks.learning_batch import to_tensor
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.building_blocks.surrogates import surrogate
from recrl.agents.errors import require_finite
from recrl.agents.experience import ActiveConstraints, Experience
from recrl.agents.shared_options import TrustRegionConfig
from recrl.agents.trust_region.conjugate_gradient import conjugate_gradient
from recrl.agents.trust_region.cpo_dual import DualSolution, StepProblem
from recrl.agents.trust_region.fisher_metric import FisherMetric
from recrl.environments.cmdp import Floats


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

    def old_surrogates(self) -> npt.NDArray[np.floating]:
        """Return the surrogates of the old policy, [1 + k]."""
        ones = torch.ones_like(self._experience.old_log_probs)
        return surrogate(ones, self._advantages).numpy(force=True)

    def surrogates_and_divergence(self) -> tuple[npt.NDArray[np.floating], float]:
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
    # Products u.H w, as in safety-starter-agents. For u = w it is the gradient times u at every iterate of
    # conjugate gradients. For others only once they have converged; until then this gives the step's length.
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


def improvement(model: LocalModel, lowered: int | None, target_kl: float) -> Callable[[], bool]:
    """Return the line search's test of a step on one surrogate: it is not worse, and the KL is within delta.

    Args:
        model: gives surrogates and KL.
        lowered: the cost whose surrogate must not rise; None for the reward's, which must not fall.
        target_kl: delta.
    """
    before = model.old_surrogates()

    def is_acceptable() -> bool:
        now, divergence = model.surrogates_and_divergence()
        improved = now[0] >= before[0] if lowered is None else now[1 + lowered] <= before[1 + lowered]
        return bool(improved) and divergence <= target_kl

    return is_acceptable
