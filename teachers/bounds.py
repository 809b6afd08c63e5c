"""Worst-case cost of a curriculum: Lemma 1 and Proposition 1 of the paper (section 5.2), and the inverse.

CPO bounds the violation of one update (Lemma 1). Summed over the updates of a training phase under the limits
D(b) of a curriculum, this bounds the cost of the whole phase (Proposition 1). The inverse gives the largest
d_t within a budget of cumulative cost.

*Index.* In the paper each policy runs one episode, b = 1 ... B. Here b counts the policies, n of them; a
trial that collects E episodes with each costs E times as much.

*Clock.* In Algorithm 1 policy b learns under p = b / n: the first limit is already below d_t, and the last
one is d_d. A trial sets the limit before it collects: p = (b - 1) / n, and the first limit is d_t. The sum of
its limits, ``weight_sum``, is then larger by D(0) - D(1) = d_t - d_d.

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
from collections.abc import Sequence

from recrl.teachers.static import Decay, constant, cosine, exponential, limit_at, linear

# The curricula with a bound known in advance. The limits of ``dynamic`` are unknown, but at most d_t like
# those of ``step``.
DECAYS: dict[str, Decay] = {
    "none": lambda p, train_limit, deploy_limit: deploy_limit,
    "step": constant,
    "dynamic": constant,
    "linear": linear,
    "cosine": cosine,
    "exponential": exponential,
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
    if kl == 0.0 and not math.isnan(advantage):
        return 0.0  # the policy has not changed, so an advantage without a bound does not matter
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
    excess = math.sqrt(2 * kl) * horizon * (horizon - 1)
    return excess * advantage if excess or math.isnan(advantage) else 0.0


def weight_sum(curriculum: str, policies: int) -> float:
    """Return the sum of the weights of d_t in a trial's limits, sum_b w((b - 1) / n).

    Raises:
        ValueError: the curriculum has no bound, or there are no policies.

    >>> weight_sum("linear", 4)  # 1 + 3/4 + 2/4 + 1/4
    2.5
    """
    if policies < 1:
        raise ValueError(f"there must be at least 1 policy, got {policies}")
    if curriculum not in DECAYS:
        raise ValueError(f"only {', '.join(DECAYS)} have a bound before they have run, got {curriculum!r}")
    return math.fsum(limit_at(b / policies, 1.0, 0.0, DECAYS[curriculum]) for b in range(policies))


def largest_train_limit(
    curriculum: str, budget: float, deploy_limit: float, *, excesses: Sequence[float]
) -> float:
    """Return the largest d_t of a trial for which sum_b (D(b) + excess_b) is within a budget.

    d_t = d_d + (budget - n d_d - sum_b excess_b) / sum_b w(p_b); infinite if d_t does not matter.

    Args:
        curriculum: a key of ``DECAYS``.
        budget: allowed cumulative cost, discounted or not like the excesses.
        deploy_limit: d_d, finite and at least 0.
        excesses: of each policy, [n], n >= 1.

    Raises:
        ValueError: the curriculum has no bound, not even d_t = d_d is within the budget, or an argument is
            out of its range.

    >>> largest_train_limit("linear", 281.0, 20.0, excesses=[0.25] * 4)
    100.0
    """
    if not 0.0 <= deploy_limit < math.inf:
        raise ValueError(f"deploy_limit must be finite and at least 0, got {deploy_limit:g}")
    weights = weight_sum(curriculum, len(excesses))
    least = len(excesses) * deploy_limit + math.fsum(excesses)
    if not budget >= least:  # also catches NaN
        raise ValueError(
            f"budget must be at least {least:g}, the bound for d_t = d_d = {deploy_limit:g} over "
            f"{len(excesses)} policies, got {budget:g}"
        )
    return math.inf if weights == 0.0 else deploy_limit + (budget - least) / weights


def _require_at_least_0(kl: float, advantage: float) -> None:
    if kl < 0.0 or advantage < 0.0:
        raise ValueError(f"kl and advantage must be at least 0, got {kl:g} and {advantage:g}")
