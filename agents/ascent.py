"""First-order improvement of a policy: full-batch Adam steps up an objective, until it has moved too far.

Letters: N samples, D decisions, k costs.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from recrl.agents.actor_critic import indexed
from recrl.agents.batch import LearningBatch
from recrl.agents.config import AscentConfig
from recrl.agents.distributions import Distribution, mean_divergence
from recrl.agents.errors import require_finite
from recrl.agents.networks import Adam
from recrl.agents.policies import StochasticPolicy
from recrl.agents.surrogates import surrogate
from recrl.environments.cmdp import Floats

# What is climbed: a differentiable scalar of the policy's distributions at the batch's rows, and of the
# probability ratios pi(a | s) / pi_old(a | s) of its decisions, [D].
Objective = Callable[[Distribution, Tensor], Tensor]


def with_entropy(gain: Callable[[Tensor], Tensor], batch: LearningBatch, bonus: float) -> Objective:
    """A function of the ratios alone, plus ``bonus`` times the mean entropy in nats."""

    def objective(now: Distribution, ratios: Tensor) -> Tensor:
        if bonus == 0.0:
            return gain(ratios)
        return gain(ratios) + bonus * torch.dot(batch.row_weights, now.entropy())

    return objective


def with_prices(gain: Callable[[Tensor], tuple[Tensor, float]]) -> Objective:
    """A function of the ratios that also says what it charges for costs, over 1 + that price.

    A penalty's gradients are as long as its price. Adam, whose steps remember the length of past gradients,
    would leave a violated constraint fast and come back to it slowly; divided by the price, all gradients are
    of one length, and every point that was optimal still is.
    """

    def objective(_: Distribution, ratios: Tensor) -> Tensor:
        value, price = gain(ratios)
        return value / (1.0 + price)

    return objective


def climb(
    policy: StochasticPolicy,
    optimiser: Adam,
    batch: LearningBatch,
    objective: Objective,
    *,
    steps: int,
    largest_kl: float,
) -> int:
    """Climb ``objective`` from the policy that collected the samples.

    Args:
        policy: changed in place.
        optimiser: of its parameters.
        batch: the collapsed samples.
        objective: what to climb.
        steps: the most to take; none leaves the policy as it is.
        largest_kl: stop once the mean KL from the old policy exceeds this, nats.

    Returns:
        The number of steps taken.

    Raises:
        DivergedError: the KL is not finite.
    """
    old = policy.distribution(batch.rows)
    old_log_probs = old.log_prob(batch.actions, batch.decision_rows)
    taken, divergence = 0, 0.0
    for taken in range(steps + 1):
        now = policy.evaluate(batch.rows)
        with torch.no_grad():
            divergence = float(mean_divergence(old, now.distribution, batch.row_weights))
        if taken == steps or divergence > largest_kl:
            break
        ratios = torch.exp(now.distribution.log_prob(batch.actions, batch.decision_rows) - old_log_probs)
        now.gradient(-objective(now.distribution, ratios))
        optimiser.step()
    require_finite("the KL of the policy's steps", divergence)
    return taken


def ascend(
    policy: StochasticPolicy,
    optimiser: Adam,
    batch: LearningBatch,
    advantages: Floats,
    *,
    objective: Objective | None,
    config: AscentConfig,
) -> dict[str, float]:
    """Climb as far as the options allow, or stay where ``objective`` is None; what it brought, as metrics.

    Args:
        policy: changed in place.
        optimiser: of its parameters.
        batch: the collapsed samples.
        advantages: raw, [N, 1 + k]; the metrics ``surrogate_reward`` and ``surrogate_cost_i`` are in their
            units.
        objective: what to climb.
        config: how far.
    """
    before = policy.distribution(batch.rows).log_prob(batch.actions, batch.decision_rows)
    steps = 0
    if objective is not None:
        largest_kl = config.stop_kl_factor * config.target_kl
        steps = climb(policy, optimiser, batch, objective, steps=config.policy_steps, largest_kl=largest_kl)
    after = policy.distribution(batch.rows).log_prob(batch.actions, batch.decision_rows)
    centred = batch.per_decision(advantages - advantages.mean(axis=0))
    gains = surrogate(torch.exp(after - before), centred).numpy()
    return {
        "policy_steps": float(steps),
        "surrogate_reward": float(gains[0]),
        **indexed("surrogate_cost", gains[1:]),
    }
