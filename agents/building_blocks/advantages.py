"""Generalised advantage estimation for the reward and every cost at once, and the units of the estimates.

Notation: T steps, B environments, N = T B samples, C = 1 + k signals (the reward, then the k costs), M
truncated steps, gamma the discount, lambda the GAE parameter.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats

SMALLEST_STD = 1e-8


def next_values(
    values: Floats,
    *,
    terminated: npt.NDArray[np.bool_],
    truncated: npt.NDArray[np.bool_],
    final_values: Floats,
    last_values: Floats,
) -> Floats:
    """Return the value of the true successor of each step.

    Inside an episode it is V(s_{t+1}), and 0 after a termination. After a time-out it is the value of the
    true last observation, not that of the next episode in row t + 1. At the rollout's end it is the value of
    the next observation.

    Args:
        values: V(s_t), [T, B, C].
        terminated: [T, B].
        truncated: [T, B].
        final_values: of the true last observations of the M truncated steps in row-major order, [M, C].
        last_values: of the observations after the rollout, [B, C].

    Returns:
        [T, B, C].
    """
    following = np.concatenate([values[1:], last_values[None]])
    following[truncated] = final_values
    following[terminated] = 0.0
    return following


def generalised_advantages(
    signals: Floats,
    values: Floats,
    following: Floats,
    *,
    ended: npt.NDArray[np.bool_],
    discount: float,
    trace_decays: Floats,
) -> Floats:
    """Generalised advantage estimates (Schulman et al. 2016, equation 16), in one backward pass.

    delta_t = r_t + gamma V(s_{t+1}) - V(s_t);  A_t = delta_t + gamma lambda A_{t+1} within an episode.

    Args:
        signals: rewards and costs a step, [T, B, C].
        values: V(s_t), [T, B, C].
        following: V(s_{t+1}) of ``next_values``, [T, B, C].
        ended: the step ended an episode, for good or by a time-out, [T, B].
        discount: gamma in [0, 1].
        trace_decays: lambda in [0, 1] of each signal, [C].

    Returns:
        [T, B, C].
    """
    advantages: Floats = signals + discount * following - values
    carry = (discount * trace_decays) * ~ended[..., None]
    for step in range(len(advantages) - 2, -1, -1):
        advantages[step] += carry[step] * advantages[step + 1]
    return advantages


def reward_spread(advantages: Floats) -> float:
    """The standard deviation of the reward's advantages, [N, 1 + k], at least a number above 0."""
    return max(float(advantages[:, 0].std()), SMALLEST_STD)


def standardised_advantages(advantages: Floats) -> tuple[Floats, Floats]:
    """Centre all advantages and divide each signal's by its own standard deviation.

    A constrained step does not depend on the units of reward and costs, if its violations are divided by
    the same numbers.

    Args:
        advantages: raw, [N, 1 + k].

    Returns:
        The quotients, [N, 1 + k], and the standard deviations, above 0, [1 + k].
    """
    centred = advantages - advantages.mean(axis=0)
    spreads = np.maximum(centred.std(axis=0), SMALLEST_STD)
    return centred / spreads, spreads


def standardised_rewards(advantages: Floats) -> Floats:
    """Centre the reward's advantages and divide them by their standard deviation, [N, 1 + k] -> [N]."""
    centred: Floats = advantages[:, 0] - advantages[:, 0].mean()
    return centred / reward_spread(advantages)


def penalised_advantages(rewards: Floats, costs: Floats, multipliers: Floats) -> Floats:
    """The advantages of the Lagrangian, (A_r - sum_i p_i A_i) / (1 + sum_i p_i), [N].

    Args:
        rewards: A_r, [N].
        costs: A_i, [N, k].
        multipliers: p, [k].
    """
    weight = 1.0 / (1.0 + float(multipliers.sum()))
    return weight * (rewards - costs @ multipliers)
