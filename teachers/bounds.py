"""Worst-case cost of a curriculum: Lemma 1 and Proposition 1 of the paper (section 5.2), and the inverse.

CPO bounds the violation of one update (Lemma 1). Summed over the updates of a training phase under the limits
D(b) of a curriculum, this bounds the cost of the whole phase (Proposition 1). The inverse gives the largest
d_t within a budget of cumulative cost.

*Index.* In the paper each policy runs one episode, b = 1 ... B. Here b counts the policies, n of them; a
trial that collects E episodes with each costs E times as much.

*Clock.* In Algorithm 1 policy b learns under p = b / n (``end``): the first limit is already below d_t, and
the last one is d_d. A trial sets the limit before it collects (``start``): p = (b - 1) / n, and the first
limit is d_t. The sum is then larger by D(0) - D(1) = d_t - d_d.

*The paper's sum.* Its proof has sum D(b) = B (d_d + d_t) / 2 for the linear curriculum. The sum of Algorithm
1's limits is smaller by (d_t - d_d) / 2, so Proposition 1 holds. A trial's sum is larger by the same amount.

*Discounting.* Lemma 1 is about the discounted cost, sum gamma^t c_t. Limits in this package are on the
undiscounted cost of an episode; ``undiscounted_excess`` has a corresponding lemma with proof. Do not add
discounted and undiscounted values.

The bounds hold for updates that solve CPO's problem under a finite limit. They do not cover recovery steps,
updates with noise, and updates during the measurement of an infinite d_t.

Notation: d_t, d_d training and deployment limit of one cost, d a limit in force, n the number of policies, p
in [0, 1] progress, w(p) the weight of d_t in D = d_d + w (d_t - d_d), delta the bound on (or the measured)
mean KL divergence of an update, eps = max_s |E_{a ~ new policy} A_C(s, a)|, gamma the discount, H the
horizon.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

# Time of a policy's progress: p = b / n (Algorithm 1) or p = (b - 1) / n (a trial).
Clock = Literal["start", "end"]

# integral_0^1 w(p) dp, of the curricula with a bound known in advance. The limits of ``dynamic`` are unknown,
# but at most d_t like those of ``step``.
MEAN_WEIGHTS: dict[str, float] = {
    "none": 0.0,
    "step": 1.0,
    "dynamic": 1.0,
    "linear": 1 / 2,
    "cosine": 2 / math.pi,
    "exponential": (math.e - 2) / (math.e - 1),
}

# sum_{b=1}^n w(b / n) as a function of n
_WEIGHT_SUMS: dict[str, Callable[[int], float]] = {
    "none": lambda n: 0.0,
    "step": lambda n: n - 1.0,
    "dynamic": lambda n: n - 1.0,
    "linear": lambda n: (n - 1) / 2,
    "cosine": lambda n: (1 / math.tan(math.pi / (4 * n)) - 1) / 2,
    "exponential": lambda n: 1 / math.expm1(1 / n) - n / (math.e - 1),
}


def discounted_excess(kl: float, advantage: float, *, discount: float) -> float:
    """Bound the excess of one update's discounted cost over its limit (Lemma 1).

    sqrt(2 delta) gamma eps / (1 - gamma)^2, from J_C(pi_{b+1}) <= d + this.

    Args:
        kl: delta, at least 0.
        advantage: eps, of the discounted costs, at least 0.
        discount: gamma, in [0, 1]; the bound is infinite for 1.

    Raises:
        ValueError: an argument is out of its range.

    >>> discounted_excess(0.02, 5.0, discount=0.5)
    2.0
    """
    if discount < 0.0 or discount > 1.0:  # unknown values, NaN, give NaN
        raise ValueError(f"discount must lie in [0, 1], got {discount}")
    _require_at_least_0(kl, advantage)
    if discount == 1.0:
        return math.inf
    return math.sqrt(2 * kl) * discount * advantage / (1 - discount) ** 2


def undiscounted_excess(kl: float, advantage: float, *, horizon: int) -> float:
    """Bound the excess of one update's undiscounted episode cost over its limit.

    sqrt(2 delta) H (H - 1) eps: Lemma 1 for episodes of at most H steps without discounting; ours, not the
    paper's. J_C(new) - J_C(old) is the sum over t of E A_t under the new policy's states. CPO constrains it
    under the old policy's states instead. The state distributions at t differ (in L1) by at most 2 sum_{j<t}
    E TV(new, old), TV <= sqrt(KL / 2) (Pinsker), and |E A_t| <= eps. Sum over t = 1 ... H - 1.

    Args:
        kl: delta, mean over the steps of the old policy's episodes, at least 0.
        advantage: eps, of the undiscounted costs that remain in the episode, at least 0.
        horizon: H, at least 1.

    Raises:
        ValueError: an argument is out of its range.

    >>> undiscounted_excess(0.02, 3.0, horizon=5)
    12.0
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, got {horizon}")
    _require_at_least_0(kl, advantage)
    return math.sqrt(2 * kl) * horizon * (horizon - 1) * advantage


def weight_sum(curriculum: str, *, policies: int, clock: Clock) -> float:
    """Return the sum of the weights of d_t, sum_b w(p_b), in closed form.

    With p_b = b / n: linear (n - 1) / 2; cosine (cot(pi / 4n) - 1) / 2; exponential
    1 / (e^(1/n) - 1) - n / (e - 1); step n - 1. With p_b = (b - 1) / n one more, w(0) - w(1) = 1.

    Raises:
        ValueError: the curriculum has no bound, or there are no policies.

    >>> weight_sum("linear", policies=4, clock="end")  # 3/4 + 2/4 + 1/4 + 0
    1.5
    """
    _require_bound(curriculum, policies)
    at_start = 1.0 if clock == "start" and curriculum != "none" else 0.0
    return _WEIGHT_SUMS[curriculum](policies) + at_start


def cumulative_bound(
    curriculum: str, train_limit: float, deploy_limit: float, *, excesses: Sequence[float], clock: Clock
) -> float:
    """Bound the cost of a training phase: sum_b (D(b) + excess_b), in closed form.

    Args:
        curriculum: a key of ``MEAN_WEIGHTS``.
        train_limit: d_t, finite.
        deploy_limit: d_d, at most d_t.
        excesses: of each policy, [n], n >= 1; all discounted or all undiscounted.
        clock: time of a policy's progress.

    Returns:
        A bound on the sum over the n policies of their expected cost per episode.

    Raises:
        ValueError: the curriculum has no bound, or an argument is out of its range.
    """
    _require_limits(train_limit, deploy_limit)
    weights = weight_sum(curriculum, policies=len(excesses), clock=clock)
    return len(excesses) * deploy_limit + weights * (train_limit - deploy_limit) + math.fsum(excesses)


def proposition_1(
    curriculum: str, train_limit: float, deploy_limit: float, *, excesses: Sequence[float]
) -> float:
    """Return Proposition 1 for any curriculum: n (d_d + (d_t - d_d) integral w) + sum_b excess_b.

    For the linear one it is n (d_d + d_t) / 2 + sum_b excess_b as in the paper. The weights decrease, so
    their sum at p = b / n is at most n times the integral. So it bounds ``cumulative_bound`` with the clock
    ``end``, not with ``start``.

    Args:
        curriculum: a key of ``MEAN_WEIGHTS``.
        train_limit: d_t, finite.
        deploy_limit: d_d, at most d_t.
        excesses: of each policy, [n], n >= 1.

    Raises:
        ValueError: the curriculum has no bound, or an argument is out of its range.

    >>> proposition_1("linear", 100.0, 20.0, excesses=[0.5, 0.5])
    121.0
    """
    _require_bound(curriculum, len(excesses))
    _require_limits(train_limit, deploy_limit)
    mean_limit = deploy_limit + MEAN_WEIGHTS[curriculum] * (train_limit - deploy_limit)
    return len(excesses) * mean_limit + math.fsum(excesses)


def largest_train_limit(
    curriculum: str, budget: float, deploy_limit: float, *, excesses: Sequence[float], clock: Clock
) -> float:
    """Return the largest d_t with a ``cumulative_bound`` within a budget.

    d_t = d_d + (budget - n d_d - sum_b excess_b) / sum_b w(p_b); infinite if d_t does not matter.

    Args:
        curriculum: a key of ``MEAN_WEIGHTS``.
        budget: allowed cumulative cost, discounted or not like the excesses.
        deploy_limit: d_d, finite and at least 0.
        excesses: of each policy, [n], n >= 1.
        clock: time of a policy's progress.

    Raises:
        ValueError: the curriculum has no bound, not even d_t = d_d is within the budget, or an argument is
            out of its range.

    >>> largest_train_limit("linear", 281.0, 20.0, excesses=[0.25] * 4, clock="start")
    100.0
    """
    _require_limits(deploy_limit, deploy_limit)
    weights = weight_sum(curriculum, policies=len(excesses), clock=clock)
    least = len(excesses) * deploy_limit + math.fsum(excesses)
    if not budget >= least:  # also catches NaN
        raise ValueError(
            f"budget must be at least {least:g}, the bound for d_t = d_d = {deploy_limit:g} over "
            f"{len(excesses)} policies, got {budget:g}"
        )
    return math.inf if weights == 0.0 else deploy_limit + (budget - least) / weights


def _require_bound(curriculum: str, policies: int) -> None:
    """Raise ValueError if the curriculum's limits are not known in advance, or there are no policies."""
    if policies < 1:
        raise ValueError(f"there must be at least 1 policy, got {policies}")
    if curriculum not in MEAN_WEIGHTS:
        raise ValueError(
            f"only {', '.join(MEAN_WEIGHTS)} have a bound before they have run, got {curriculum!r}"
        )


def _require_limits(train_limit: float, deploy_limit: float) -> None:
    if not 0.0 <= deploy_limit <= train_limit < math.inf:
        raise ValueError(
            "limits must be finite with train_limit >= deploy_limit >= 0 (d_t >= d_d), "
            f"got {train_limit:g} and {deploy_limit:g}"
        )


def _require_at_least_0(kl: float, advantage: float) -> None:
    if kl < 0.0 or advantage < 0.0:
        raise ValueError(f"kl and advantage must be at least 0, got {kl:g} and {advantage:g}")
