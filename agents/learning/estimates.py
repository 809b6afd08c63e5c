"""Estimates from a rollout: advantages, the critics' targets, and explained variance.

Notation: N samples, C = 1 + k signals, U distinct observations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor

from recrl.agents.building_blocks.learning_batch import LearningBatch, to_tensor
from recrl.agents.building_blocks.scales import quotient
from recrl.agents.learning.policy_rule import indexed
from recrl.environments.cmdp import Floats


@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates of the signals from a rollout, all [N, C].

    Attributes:
        advantages: generalised advantage estimates.
        targets: the critics' regression targets.
        values: predictions of the critics before the update.
        returns: discounted sums of the signals up to the end of the episode or the rollout, bootstrapped
            there with the critics' value.
    """

    advantages: Floats
    targets: Floats
    values: Floats
    returns: Floats

    def explained_variances(self) -> dict[str, float]:
        """Return the critics' explained variance of new returns, 1 - Var(returns - values) / Var(returns).

        1 is perfect, 0 is no better than a constant, NaN if all returns are equal. The bootstrap value in the
        returns is the critics' own, which biases the result upwards a little.
        """
        spread = self.returns.var(axis=0)
        unexplained = (self.returns - self.values).var(axis=0)
        shares = np.where(spread > 0.0, 1.0 - quotient(unexplained, spread), np.nan)
        return {"explained_variance_reward": float(shares[0])} | indexed(
            "explained_variance_cost", shares[1:]
        )


def row_targets(batch: LearningBatch, targets: Floats) -> tuple[Tensor, Tensor]:
    """Return the regression target of each row that minimises the mean squared error over the samples.

    The error over samples is the error about the mean target of each row, weighted by its fraction of the
    samples, plus the targets' variance. No critic can reduce the latter.

    Args:
        batch: the samples.
        targets: of all samples of the rollout, [N, C].

    Returns:
        The mean targets, [C, U], and the spread, [C].
    """
    sums = batch.per_observation(targets)
    shares = batch.observation_weights.numpy(force=True).astype(np.float64)[:, None]
    spread = np.mean(batch.own(targets) ** 2, axis=0) - np.sum(sums**2 / shares, axis=0)
    return to_tensor((sums / shares).T.copy()), to_tensor(np.maximum(spread, 0.0))
