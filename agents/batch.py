"""From a rollout to what learning needs, with repeated observations evaluated once.

On a tabular task a rollout of thousands of samples holds a few hundred distinct observations. Networks are
then evaluated on the distinct *rows*, and everything that is summed over samples is summed by row, or by
*decision* (distinct pair of row and discrete action), beforehand. This is exact, not an approximation: a
mean over samples of a function of the row is a weighted mean over rows; squared errors about several
targets of one row are those about the targets' mean plus a constant; and a clipped surrogate, which depends
on an advantage's sign, is linear in the positive and in the negative advantages of a decision. Where rows do
not repeat, every sample is its own row and decision, and the same formulas hold.

Letters: N samples, U distinct rows, D decisions, n observation components, k costs, C = 1 + k signals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from recrl.environments.cmdp import Floats

# Rows are only worth gathering if there are fewer than this share of the samples.
WORTHWHILE_SHARE = 0.5

Indices = npt.NDArray[np.int64]


def distinct_rows(observations: npt.NDArray[np.float32]) -> tuple[Indices, Indices] | None:
    """Find equal rows, by a 64-bit hash that is then checked against the rows themselves.

    Args:
        observations: [N, n].

    Returns:
        The first sample of each distinct row, [U], and the row of each sample, [N]; or None if rows seldom
        repeat (U > N / 2), or in the improbable case that two different rows have one hash.
    """
    words = np.ascontiguousarray(observations).view(np.uint32).astype(np.uint64)
    factors = np.random.default_rng(0).integers(2**64, size=words.shape[1], dtype=np.uint64)
    first, row = np.unique(words @ factors, return_index=True, return_inverse=True)[1:]
    if len(first) > WORTHWHILE_SHARE * len(observations):
        return None
    if not np.array_equal(observations[first][row], observations):
        return None
    return first, row


def by_group(samples: Floats, group: Indices | None, num_groups: int) -> Floats:
    """Sums of samples [N] or [N, C] over each group, divided by N: [G] or [G, C].

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
    return np.stack([by_group(column, group, num_groups) for column in samples.T], axis=1)


def to_tensor(values: Floats) -> Tensor:
    """A float32 tensor of float64 values."""
    return torch.from_numpy(values.astype(np.float32))


@dataclass(frozen=True, eq=False)
class LearningBatch:
    """The samples of a rollout, with repeated observations and decisions collapsed.

    Attributes:
        rows: distinct observations, float32 [U, n].
        row_weights: share of the samples at each, [U], summing to 1.
        actions: the action of each decision, int64 [D] or float32 [D, m].
        decision_rows: the row of each decision, int64 [D], or None if decision i is at row i.
        row_of_sample: [N], or None if each sample is its own row.
        decision_of_sample: [N], or None if each sample is its own decision.
    """

    rows: Tensor
    row_weights: Tensor
    actions: Tensor
    decision_rows: Tensor | None
    row_of_sample: Indices | None
    decision_of_sample: Indices | None

    @classmethod
    def gather(
        cls, observations: npt.NDArray[np.float32], actions: npt.NDArray[Any], *, compact: bool
    ) -> LearningBatch:
        """Collapse N samples.

        Args:
            observations: [N, n].
            actions: int64 [N] or float32 [N, m].
            compact: whether to look for repeated rows at all.
        """
        found = distinct_rows(observations) if compact else None
        if found is None:
            share = torch.full((len(observations),), 1.0 / len(observations))
            return cls(torch.from_numpy(observations), share, torch.from_numpy(actions), None, None, None)
        first, row = found
        weights = to_tensor(np.bincount(row) / len(row))
        rows = torch.from_numpy(observations[first])
        if actions.ndim > 1:
            return cls(rows, weights, torch.from_numpy(actions), torch.from_numpy(row), row, None)
        num_actions = int(actions.max()) + 1
        pairs, decision = np.unique(row * num_actions + actions, return_inverse=True)
        taken, at = torch.from_numpy(pairs % num_actions), torch.from_numpy(pairs // num_actions)
        return cls(rows, weights, taken, at, row, decision)

    def per_row(self, samples: Floats) -> Floats:
        """Sums over the samples of each row, divided by N: [N] or [N, C] -> [U] or [U, C]."""
        return by_group(samples, self.row_of_sample, len(self.rows))

    def per_decision(self, samples: Floats) -> Tensor:
        """Sums over the samples of each decision, divided by N: [N] or [N, C] -> [D] or [D, C]."""
        return to_tensor(by_group(samples, self.decision_of_sample, len(self.actions)))

    def per_sample(self, values: Floats) -> Floats:
        """Hand each sample its row's values, [U, C] -> [N, C]."""
        return values if self.row_of_sample is None else values[self.row_of_sample]
