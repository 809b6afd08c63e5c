"""Batches for learning: repeated observations are evaluated once, distinct ones in minibatches.

On a tabular task a rollout of thousands of samples holds a few hundred distinct observations. Networks are
then evaluated on the *unique observations* (rows). Sums over samples are first taken by row, or by *pair*
(unique pair of row and discrete action). This is exact, not an approximation:

- A mean over samples of a function of the row is a weighted mean over rows.
- Squared errors about several targets of one row are those about the targets' mean plus a constant.
- A clipped surrogate depends on an advantage's sign; it is linear in the positive and in the negative
  advantages of a pair.

If rows do not repeat, every sample is its own row and pair, and the same formulas hold. Such a batch can be
divided into minibatches.

Notation: N samples of a rollout, U unique observations, D unique pairs, n observation components, k costs, C
= 1 + k signals.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.environments.cmdp import Floats

# Rows are collapsed only if there are fewer than this fraction of the samples.
WORTHWHILE_SHARE = 0.5

Indices = npt.NDArray[np.int64]


def find_repeated(
    observations: npt.NDArray[np.float32], most: int | None = None
) -> tuple[Indices, Indices] | None:
    """Find equal rows, by a 64-bit hash that is then checked against the rows themselves.

    Args:
        observations: [N, n].
        most: largest useful number of unique observations, at least 1; no bound if None.

    Returns:
        The first sample of each distinct row, [U], and the row of each sample, [N]. None if rows seldom
        repeat (U > N / 2) or are more than ``most``, or if two different rows have the same hash, which is
        improbable.
    """
    words = np.ascontiguousarray(observations).view(np.uint32).astype(np.uint64)
    factors = np.random.default_rng(0).integers(2**64, size=words.shape[1], dtype=np.uint64)
    first, row = np.unique(words @ factors, return_index=True, return_inverse=True)[1:]
    if len(first) > WORTHWHILE_SHARE * len(observations) or len(first) > (most or len(first)):
        return None
    if not np.array_equal(observations[first][row], observations):
        return None
    return first, row


def by_group(samples: Floats, group: Indices | None, num_groups: int) -> Floats:
    """Sum samples [N] or [N, C] over each group and divide by N: [G] or [G, C].

    The sum over groups is then the mean over samples.

    Args:
        samples: float64.
        group: the group of each sample, [N], or None if each sample is its own.
        num_groups: G.
    """
    if group is None:
        return samples / len(samples)
    if samples.ndim == 1:
        return np.bincount(group, weights=samples, minlength=num_groups) / len(samples)
    sums = np.empty((num_groups, samples.shape[1]))
    for column in range(samples.shape[1]):
        sums[:, column] = by_group(samples[:, column], group, num_groups)
    return sums


def to_tensor(values: Floats) -> Tensor:
    """Make a tensor of float64 values, in their shape, in the precision and on the device of learning."""
    return torch.as_tensor(values, dtype=torch.get_default_dtype())


@dataclass(frozen=True, eq=False)
class LearningBatch:
    """The samples of a rollout, with repeated observations and pairs collapsed; or a minibatch of them.

    Attributes:
        unique_observations: distinct observations, float32 [U, n].
        observation_weights: fraction of the samples at each, [U], summing to 1.
        actions: the action of each pair, int64 [D] or float32 [D, m].
        pair_observations: the row of each pair, int64 [D], or None if pair i is at row i.
        observation_of_sample: [N], or None if each sample is its own row.
        pair_of_sample: [N], or None if each sample is its own pair.
        samples: indices of the rollout's samples in a minibatch, [U]; None for all.
    """

    unique_observations: Tensor
    observation_weights: Tensor
    actions: Tensor
    pair_observations: Tensor | None
    observation_of_sample: Indices | None
    pair_of_sample: Indices | None
    samples: Indices | None = None

    @classmethod
    def deduplicate(
        cls,
        observations: npt.NDArray[np.float32],
        actions: npt.NDArray[Any],
        *,
        compact: bool,
        most_observations: int | None = None,
    ) -> LearningBatch:
        """Collapse N samples.

        Args:
            observations: [N, n].
            actions: int64 [N] or float32 [N, m].
            compact: whether to look for repeated rows.
            most_observations: do not collapse more distinct rows than this.
        """
        found = find_repeated(observations, most_observations) if compact else None
        if found is None:
            share = torch.full((len(observations),), 1.0 / len(observations))
            return cls(torch.as_tensor(observations), share, torch.as_tensor(actions), None, None, None)
        first, row = found
        weights = to_tensor(np.bincount(row) / len(row))
        rows = torch.as_tensor(observations[first])
        if actions.ndim > 1:
            return cls(rows, weights, torch.as_tensor(actions), torch.as_tensor(row), row, None)
        num_actions = int(actions.max()) + 1
        pairs, pair = np.unique(row * num_actions + actions, return_inverse=True)
        taken, at = torch.as_tensor(pairs % num_actions), torch.as_tensor(pairs // num_actions)
        return cls(rows, weights, taken, at, row, pair)

    def num_minibatches(self, size: int | None) -> int:
        """Return the number of minibatches of about ``size`` rows in an epoch; one if rows repeat."""
        if size is None or self.observation_of_sample is not None:
            return 1
        return -(-len(self.unique_observations) // size)

    def minibatches(self, size: int | None, generator: np.random.Generator) -> Iterator[LearningBatch]:
        """Yield minibatches without end: epochs over the samples, each in a new random order.

        Args:
            size: rows of a minibatch, at most; None for all.
            generator: for the order; not used if the batch is a single part.
        """
        num_minibatches = self.num_minibatches(size)
        while True:
            if num_minibatches == 1:
                yield self
                continue
            for chosen in np.array_split(
                generator.permutation(len(self.unique_observations)), num_minibatches
            ):
                yield self.minibatch(chosen)

    def minibatch(self, samples: Indices) -> LearningBatch:
        """Return some samples, [U], of a batch in which each sample is its own row."""
        index = torch.as_tensor(samples)
        return LearningBatch(
            unique_observations=self.unique_observations.index_select(0, index),
            observation_weights=torch.full((len(samples),), 1.0 / len(samples)),
            actions=self.actions.index_select(0, index),
            pair_observations=None,
            observation_of_sample=None,
            pair_of_sample=None,
            samples=samples,
        )

    def thinned(self, most: int | None, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
        """Return rows and their weights: of all samples, or of ``most`` samples drawn at random.

        Args:
            most: rows to keep, at most; None for all.
            generator: for the draw; not used if all rows are kept.
        """
        if most is None or len(self.unique_observations) <= most:
            return self.unique_observations, self.observation_weights
        num_samples = len(
            self.unique_observations if self.observation_of_sample is None else self.observation_of_sample
        )
        drawn = generator.choice(num_samples, size=most, replace=False)
        rows = drawn if self.observation_of_sample is None else self.observation_of_sample[drawn]
        kept, counts = np.unique(rows, return_counts=True)
        return self.unique_observations.index_select(0, torch.as_tensor(kept)), to_tensor(counts / most)

    def per_observation(self, samples: Floats) -> Floats:
        """Sum over the samples of each row and divide by N: [N] or [N, C] -> [U] or [U, C]."""
        return by_group(self.own(samples), self.observation_of_sample, len(self.unique_observations))

    def per_pair(self, samples: Floats) -> Tensor:
        """Sum over the samples of each pair and divide by N: [N] or [N, C] -> [D] or [D, C]."""
        return to_tensor(by_group(self.own(samples), self.pair_of_sample, len(self.actions)))

    def per_sample(self, values: Floats) -> Floats:
        """Give each sample its row's values, [U, C] -> [N, C]."""
        return values if self.observation_of_sample is None else values[self.observation_of_sample]

    def own(self, samples: Floats) -> Floats:
        """Select from a rollout's samples, [N] or [N, C], those in the batch."""
        return samples if self.samples is None else samples[self.samples]
