"""How much of what a step promises to do to a cost it does: judged on samples that did not choose the step.

The direction w = H^-1 b along which a cost falls fastest is fitted to the samples whose advantages then say
how far it falls, b.w. That promise is too good: with b = beta + noise,

    E[b.H^-1 b] = beta.H^-1 beta + tr(H^-1 Cov b),

and the second term, which no other sample confirms, is what is left if the advantages are pure noise. Where
observations hardly repeat and advantages are noisy it is by far the larger one
(``tests/benchmarks/held_out.py``; on CarGoal2 with 8,000 samples more than nine tenths). A student that takes
the promise at its word believes that one step mends most violations, spends the rest of its trust region on
the reward, and stays where it is: above its limit.

So the environments are parted into two halves whose samples are independent given the policy, with gradients
b_A and b_B. What one half's direction does on the other is unbiased, E[b_A.H^-1 b_B] = beta.H^-1 beta (H held
fixed), and follows from a single further solution, with the contrast e = b - 2 n_B b_B = n_A b_A - n_B b_B of
the halves' shares n_A + n_B = 1:

    b_A.H^-1 b_B = (b.H^-1 b - e.H^-1 e) / (4 n_A n_B).

That holds for an exact H^-1; conjugate gradients that stop early are not quite linear in what they solve
for. Single products are noisy, so both are averaged over updates, b_A.H^-1 b_B and b.H^-1 b, before one is
divided by the other: the share of the promise that is kept. A violation c then counts as c / share.

Letters: N samples, B environments, k costs, j of them limited. The products are squares of cost per step,
per nat.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats

MEMORY = 0.9
"""What the averages keep from one update to the next: they remember about ten."""
SMALLEST_SHARE = 1e-3
"""Of a promise of which nothing can be confirmed: any violation is then out of one step's reach."""


def halves(num_samples: int, num_envs: int) -> Floats:
    """+1 for the samples of the first half of the environments, -1 for those of the second, [N].

    With a single environment, for the first and second half of its time, which are not quite independent.

    Args:
        num_samples: N, a multiple of B; sample i is of environment i mod B.
        num_envs: B, at least 1.

    >>> halves(6, 3), halves(4, 1)
    (array([ 1., -1., -1.,  1., -1., -1.]), array([ 1.,  1., -1., -1.]))
    """
    position, size = np.arange(num_samples), num_samples
    if num_envs > 1:
        position, size = position % num_envs, num_envs
    return np.where(position < size // 2, 1.0, -1.0)


def confirmed(promised: Floats, contrasts: Floats, signs: Floats) -> Floats:
    """What the samples of one half confirm of the direction that the other's chose, [j].

    Args:
        promised: b.H^-1 b, [j].
        contrasts: e.H^-1 e, [j].
        signs: of ``halves``, [N].

    Returns:
        b_A.H^-1 b_B, [j]; 0 where there is but one sample, so that there is no other half.

    >>> confirmed(np.array([5.0]), np.array([3.0]), np.array([1.0, -1.0]))
    array([2.])
    """
    first = float(np.mean(signs > 0.0))
    if first in {0.0, 1.0}:
        return np.zeros_like(promised)
    return np.asarray((promised - contrasts) / (4.0 * first * (1.0 - first)))


class KeptShares:
    """The share of what steps promise that other samples confirm, for each cost, averaged over updates.

    Args:
        num_costs: k.
    """

    def __init__(self, num_costs: int) -> None:
        self._promised = np.zeros(num_costs)
        self._confirmed = np.zeros(num_costs)

    def learn(self, index: npt.NDArray[np.int64], promised: Floats, found: Floats) -> Floats:
        """Take in one update.

        Args:
            index: the costs that have a limit, [j].
            promised: b.H^-1 b of each, at least 0, [j].
            found: what the other half confirms of it, [j].

        Returns:
            Their shares, in [SMALLEST_SHARE, 1], [j]; 1 where nothing was ever promised.
        """
        for sums, values in ((self._promised, promised), (self._confirmed, found)):
            sums[index] = MEMORY * sums[index] + values
        whole = self._promised[index]
        shares = np.divide(self._confirmed[index], whole, out=np.ones_like(whole), where=whole > 0.0)
        return np.asarray(np.clip(shares, SMALLEST_SHARE, 1.0))

    def state_dict(self) -> dict[str, Any]:
        """Both sums, [k]."""
        return {"promised": self._promised.copy(), "confirmed": self._confirmed.copy()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self._promised = np.array(state["promised"], np.float64)
        self._confirmed = np.array(state["confirmed"], np.float64)
