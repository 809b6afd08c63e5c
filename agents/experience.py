"""Experience of a rollout: samples, advantages and constraints.

Notation: N samples, k costs, D unique pairs, E finished episodes, j of the k limits are finite.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.agents.building_blocks.distributions import Distribution
from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.agents.building_blocks.policies import StochasticPolicy
from recrl.environments.cmdp import Floats


@dataclass(frozen=True, eq=False)
class Constraints:
    """Estimates of the constraints after a rollout.

    Attributes:
        limits: d, [k], possibly infinite.
        gaps: constrained value (the mean undiscounted episode cost, or its CVaR) minus limit, [k]; -inf where
            the limit is infinite.
        standard_errors: of the constrained values, [k], at least 0; 0 if there are fewer than two episodes.
        episode_length: mean steps of an episode, at least 1.
    """

    limits: Floats
    gaps: Floats
    standard_errors: Floats
    episode_length: float


@dataclass(frozen=True, eq=False)
class ActiveConstraints:
    """The constraints whose limits are finite, j of k.

    Attributes:
        index: their indices, [j].
        violations: c, (constrained value - limit) / mean episode length, in cost per step or another unit
            (``divided_by``), [j].
    """

    index: npt.NDArray[np.int64]
    violations: Floats

    @classmethod
    def of(cls, constraints: Constraints) -> ActiveConstraints:
        """Return the finite constraints, in the unit of the surrogates: cost per step."""
        index = np.flatnonzero(np.isfinite(constraints.limits))
        return cls(index, constraints.gaps[index] / constraints.episode_length)

    def divided_by(self, units: Floats) -> ActiveConstraints:
        """Return the constraints with ``violations`` divided by units of the k costs, [k]."""
        return ActiveConstraints(self.index, self.violations / units[self.index])


@dataclass(frozen=True, eq=False)
class Experience:
    """Data for improving a policy.

    Attributes:
        batch: the samples, or a minibatch of them.
        old: pi_old(. | s), of the policy that collected them, at the batch's unique observations.
        old_log_probs: log pi_old(a | s) of the batch's pairs, [D].
        advantages: raw estimates for the reward, then each cost, of all samples of the rollout, [N, 1 + k].
        constraints: limits and gaps.
    """

    batch: LearningBatch
    old: Distribution
    old_log_probs: Tensor
    advantages: Floats
    constraints: Constraints

    @classmethod
    def of(
        cls,
        policy: StochasticPolicy,
        batch: LearningBatch,
        advantages: Floats,
        constraints: Constraints,
    ) -> Experience:
        """Return the experience of the policy that collected the samples, before it changes."""
        old = policy.distribution(batch.unique_observations)
        log_probs = old.log_prob(batch.actions, batch.pair_observations)
        return cls(batch, old, log_probs, advantages, constraints)

    def minibatches(self, size: int | None, generator: np.random.Generator) -> Iterator[Experience]:
        """Yield the minibatches of ``LearningBatch.minibatches``; the experience itself if there is one."""
        for part in self.batch.minibatches(size, generator):
            if part.samples is None:
                yield self
                continue
            index = torch.as_tensor(part.samples)
            log_probs = self.old_log_probs.index_select(0, index)
            yield replace(self, batch=part, old=self.old.at(index), old_log_probs=log_probs)

    def ratios(self, now: Distribution) -> Tensor:
        """The probability ratios pi(a | s) / pi_old(a | s) of the pairs, [D]; exactly 1 for pi_old."""
        log_probs = now.log_prob(self.batch.actions, self.batch.pair_observations)
        return torch.exp(log_probs - self.old_log_probs)

    def with_entropy(self, coefficient: float) -> Experience:
        """Return the experience with a reward for the policy's entropy at every observation.

        At the policy that collected the samples, the gradient of the entropy is that of a surrogate with the
        advantages -log pi(a | s) - H(pi(. | s)). They are positive for unlikely actions. They are added to
        the reward's, so that every agent ascends both.

        Args:
            coefficient: reward per nat, at least 0.
        """
        log_probs = self.old_log_probs.numpy(force=True).astype(np.float64)
        entropies = self.old.entropy().numpy(force=True).astype(np.float64)
        batch, advantages = self.batch, self.advantages.copy()
        if batch.pair_of_sample is not None:
            log_probs = log_probs[batch.pair_of_sample]
        advantages[:, 0] -= coefficient * (log_probs + batch.per_sample(entropies))
        return replace(self, advantages=advantages)
