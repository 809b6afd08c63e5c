"""Surrogate objectives of policy gradient methods, over the pairs of a batch.

A surrogate is a mean over samples. Each term depends only on the probability ratio of the sample's pair and,
linearly, on its advantage. So advantages are summed by pair first
(``recrl.agents.building_blocks.learning_batch``). Notation: N samples, D unique pairs, k costs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from recrl.agents.building_blocks.learning_batch import LearningBatch
from recrl.environments.cmdp import Floats


def surrogate(ratios: Tensor, advantages: Tensor) -> Tensor:
    """The importance-weighted mean advantage, mean_i ratio_i A_i.

    Args:
        ratios: pi(a | s) / pi_old(a | s), [D].
        advantages: summed by pair and divided by N, [D] or [D, k].

    Returns:
        A scalar, or [k].
    """
    return ratios @ advantages


@dataclass(frozen=True, eq=False)
class SignedAdvantages:
    """Advantages split by their sign, each part summed by pair and divided by N.

    Attributes:
        positive: [D].
        negative: [D].
    """

    positive: Tensor
    negative: Tensor

    @classmethod
    def split(cls, batch: LearningBatch, advantages: Floats) -> SignedAdvantages:
        """Split the advantages of N samples, [N]."""
        return cls(batch.per_pair(np.maximum(advantages, 0.0)), batch.per_pair(np.minimum(advantages, 0.0)))

    @property
    def total(self) -> Tensor:
        """The surrogate at ratios of 1, clipped or not: the mean advantage, a scalar."""
        return self.positive.sum() + self.negative.sum()


def clipped_surrogate(ratios: Tensor, advantages: SignedAdvantages, clip: float) -> Tensor:
    """PPO's pessimistic surrogate (Schulman et al. 2017, equation 7), a scalar.

    mean_i min(ratio_i A_i, clip(ratio_i, 1 - e, 1 + e) A_i), which is
    min(ratio, 1 + e) for the positive advantages and max(ratio, 1 - e) for the negative.

    Args:
        ratios: pi(a | s) / pi_old(a | s), [D].
        advantages: by sign.
        clip: e in (0, 1).
    """
    gain = torch.dot(ratios.clamp(max=1.0 + clip), advantages.positive)
    return gain + torch.dot(ratios.clamp(min=1.0 - clip), advantages.negative)


def pessimistic_relief(ratios: Tensor, relief: Sequence[SignedAdvantages], clip: float) -> Tensor:
    """Return a lower bound on the decrease of each cost's surrogate since ratios of 1, [j].

    The pessimistic surrogate of a cost, the mean of max(ratio A, clip(ratio) A), is minus PPO's of -A. The
    decrease of a plain surrogate is unbounded. With a large penalty weight the policy would move far in one
    update, at the expense of the reward.

    Args:
        ratios: pi(a | s) / pi_old(a | s), [D].
        relief: negative advantages of each cost, by sign.
        clip: e in (0, 1).
    """
    if not relief:
        return torch.zeros(0)
    return torch.stack([clipped_surrogate(ratios, each, clip) - each.total for each in relief])
