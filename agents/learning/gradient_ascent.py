"""First-order improvement of a policy: Adam steps on an objective, until the KL is too large.

A step uses all rows of the batch, or a minibatch if they are many. The policy may take ``policy_steps``
steps, but at least ``policy_passes`` epochs. After each step the mean KL from the old policy is measured on
the rows of the next step, which are evaluated anyway. With a thousand rows its error is a few per cent.

Notation: N samples, D unique pairs, k costs.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import islice
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from recrl.agents.building_blocks.distributions import Distribution, mean_divergence
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.agents.errors import require_finite
from recrl.agents.experience import Experience
from recrl.agents.learning.policy_rule import Stateful
from recrl.agents.networks.flat_parameters import Adam
from recrl.agents.shared_options import AscentConfig, RadiusConfig

# An objective: a differentiable scalar of the policy's distributions at the rows of some samples, and of the
# probability ratios pi(a | s) / pi_old(a | s) of their pairs, [D].
Objective = Callable[[Distribution, Tensor], Tensor]


AnyAscentConfig = TypeVar("AnyAscentConfig", bound=AscentConfig)
AnyRadiusConfig = TypeVar("AnyRadiusConfig", bound=RadiusConfig)


class FirstOrderRule(Generic[AnyAscentConfig]):
    """Common part of first-order rules: the settings, the optimiser, and the ascent.

    Args:
        config: the agent's settings.
        policy: the optimiser changes its parameters.
    """

    def __init__(self, config: AnyAscentConfig, policy: StochasticPolicy) -> None:
        self._config = config
        self._optimiser = Adam(policy.parameters, config.policy_learning_rate)
        self.parts: dict[str, Stateful] = {"optimiser": self._optimiser}

    def ascend(
        self,
        policy: StochasticPolicy,
        experience: Experience,
        objective_of: Callable[[Experience], Objective],
        generator: np.random.Generator,
    ) -> dict[str, float]:
        """Change the policy by ``gradient_ascent`` and return its metrics."""
        return gradient_ascent(
            policy, self._optimiser, experience, objective_of, config=self._config, generator=generator
        )


class RadiusRule(FirstOrderRule[AnyRadiusConfig]):
    """Common part of first-order rules that keep their trust region, unless it is ``passed``."""

    def ascend(
        self,
        policy: StochasticPolicy,
        experience: Experience,
        objective_of: Callable[[Experience], Objective],
        generator: np.random.Generator,
    ) -> dict[str, float]:
        """Change the policy by ``gradient_ascent``; scale a larger change back to ``target_kl``."""
        start = policy.parameters.values.clone()
        metrics = super().ascend(policy, experience, objective_of, generator)
        if self._config.trust_region == "kept":
            keep_near(policy, experience, start, self._config.target_kl)
        return metrics


def with_entropy(
    surrogate_objective: Callable[[Tensor], Tensor], batch: LearningBatch, bonus: float
) -> Objective:
    """Make an objective of a function of the ratios, plus ``bonus`` times the mean entropy in nats."""

    def objective(now: Distribution, ratios: Tensor) -> Tensor:
        if bonus == 0.0:
            return surrogate_objective(ratios)
        return surrogate_objective(ratios) + bonus * torch.dot(batch.observation_weights, now.entropy())

    return objective


def normalised_by_penalties(surrogate_objective: Callable[[Tensor], tuple[Tensor, float]]) -> Objective:
    """Make an objective of a function of the ratios that also returns the total weight of its penalties.

    The objective is divided by 1 + that weight, because the gradients of penalties are proportional to their
    weights. Adam normalises by the size of past gradients, so the policy would leave a violated constraint
    fast and return slowly. Division by the weight gives all gradients similar sizes and does not change the
    optimum.
    """

    def objective(_: Distribution, ratios: Tensor) -> Tensor:
        value, weight = surrogate_objective(ratios)
        return value / (1.0 + weight)

    return objective


def keep_near(policy: StochasticPolicy, experience: Experience, start: Tensor, radius: float) -> None:
    """Scale a change of the parameters back to a mean KL of about the radius, if it exceeds it.

    theta <- theta_0 + sqrt(delta / KL) (theta - theta_0): exact if the KL is quadratic in the change.

    Args:
        policy: changed in place.
        experience: the samples, and pi_old at their rows.
        start: theta_0, the parameters of pi_old, [P].
        radius: delta, nats.
    """
    batch = experience.batch
    divergence = float(
        mean_divergence(
            experience.old, policy.distribution(batch.unique_observations), batch.observation_weights
        )
    )
    if divergence > radius:
        policy.parameters.values.lerp_(start, 1.0 - (radius / divergence) ** 0.5)


def gradient_ascent(
    policy: StochasticPolicy,
    optimiser: Adam,
    experience: Experience,
    objective_of: Callable[[Experience], Objective],
    *,
    config: AscentConfig,
    generator: np.random.Generator,
) -> dict[str, float]:
    """Ascend an objective from the policy that collected the samples.

    Args:
        policy: changed in place.
        optimiser: of its parameters.
        experience: the samples.
        objective_of: gives the objective of a minibatch or of all samples.
        config: minibatch size, steps and epochs, and largest KL.
        generator: for the minibatches.

    Returns:
        The number of steps taken, ``policy_steps``.

    Raises:
        DivergedError: the KL is not finite.
    """
    size = config.minibatch_size
    steps = max(config.policy_steps, config.policy_passes * experience.batch.num_minibatches(size))
    largest_kl = config.stop_kl_factor * config.target_kl
    objective_on = lru_cache(maxsize=1)(objective_of)  # the whole batch is repeated without end
    taken, divergence = 0, 0.0
    for taken, part in enumerate(islice(experience.minibatches(size, generator), steps + 1)):
        now = policy.evaluate(part.batch.unique_observations)
        with torch.no_grad():
            divergence = float(mean_divergence(part.old, now.distribution, part.batch.observation_weights))
        if taken == steps or divergence > largest_kl:
            break
        surrogate_objective = objective_on(part)(now.distribution, part.ratios(now.distribution))
        now.gradient(-surrogate_objective)
        optimiser.step()
    require_finite("the KL of the policy's steps", divergence)
    return {"policy_steps": float(taken)}
