"""Exploration noise eps_pi for a policy (Algorithm 2, line 9); the paper does not define it.

The *parameters* are changed once, and the agent continues on-policy from there. A mixture with a uniform
policy would have to be part of every later gradient. It would not help a saturated softmax either: its
gradients are about 1e-8.

``match-mixture`` makes the policy as random as the mixture (1 - eps) pi + eps uniform, never less random. A
Gaussian policy with more than two action components becomes less random than that (``matching_log_std``).
``temperature`` divides the logits by 1 / (1 - eps), or multiplies the standard deviations by it.

Notation: U distinct observations, A actions, m action components, eps = eps_pi.
"""

from __future__ import annotations

import numpy as np

from recrl.environments.cmdp import Floats

BISECTIONS = 60
# Off-greedy masses closer than this are equal; a uniform policy then does not change.
ROUNDING = 1e-12


def off_greedy_mass(logits: Floats, weights: Floats) -> float:
    """Mean probability of not taking the most likely action, in [0, 1 - 1/A].

    Args:
        logits: [U, A].
        weights: fraction of the samples at each observation, [U], summing to 1.
    """
    shifted = logits - logits.max(axis=1, keepdims=True)
    return float(weights @ (1.0 - 1.0 / np.exp(shifted).sum(axis=1)))


def matching_scale(logits: Floats, weights: Floats, noise: float) -> float:
    """Return the factor s in [0, 1] on the logits that makes the policy as random as the eps-mixture.

    Solves off_greedy_mass(s logits) = (1 - eps) off_greedy_mass(logits) + eps (1 - 1/A), by bisection. The
    left side decreases in s, so there is one solution, and s <= 1: noise never makes a policy less random.

    Args:
        logits: of the present policy, [U, A].
        weights: fraction of the samples at each observation, [U], summing to 1.
        noise: eps in (0, 1].
    """
    num_actions = logits.shape[1]
    target = (1.0 - noise) * off_greedy_mass(logits, weights) + noise * (1.0 - 1.0 / num_actions)
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if off_greedy_mass(middle * logits, weights) >= target - ROUNDING:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def matching_log_std(log_std: Floats, noise: float) -> Floats:
    """Return the log_std for the variance of the eps-mixture around the mean, in each action component.

    sigma'^2 = max(sigma^2, (1 - eps) sigma^2 + (eps / 3) min(1, 2 / m)): 1 / 3 is the variance of a uniform
    action in half ranges. With m > 2 components the uniform part has the mean squared length that it has with
    two, as the bound ``min_std``: else a robot with many joints would be disturbed more than a car.
    (The distance between the mean and the middle of the range, which adds to the mixture's variance, is left
    out: it depends on the observation.)

    Args:
        log_std: of the present policy, in half ranges, [m].
        noise: eps in (0, 1].
    """
    variance = np.exp(2.0 * log_std)
    mixed = (1.0 - noise) * variance + noise / 3.0 * min(1.0, 2.0 / len(log_std))
    return 0.5 * np.log(np.maximum(variance, mixed))
