"""The decisions of the dynamic curriculum: lines 5 to 10 of Algorithm 2, as functions of windows.

``recrl.teachers.dynamic`` has the curriculum, and says how and why these functions differ from Algorithm 2.
``recrl.teachers.algorithm_2`` uses ``has_converged``, ``keeps_limit`` and ``next_limit``, too.

Notation: d limits in force, d_d deployment limits, B the training budget in environment steps; C-bar and
r-bar the mean episode cost and return of a window; eps_r, eps_c, eps_pi the paper's settings.
"""

from __future__ import annotations

import math

from recrl.teachers.dynamic_options import DynamicConfig
from recrl.teachers.windows import WindowStatistics

LEAST_EPISODES = 10  # of a window; a standard error from fewer episodes is itself uncertain


def has_converged(new: float, old: float, *, tolerance: float, floor: float) -> bool:
    """Whether a mean has converged: abs(new - old) <= eps max(abs(old), floor).

    Algorithm 2, line 5, abs(new / old - 1) <= eps, corrected for means at or near zero.

    Args:
        new: mean over the last window.
        old: mean over the window before, of any sign.
        tolerance: eps_r or eps_c.
        floor: at least 0, in the unit of the means.

    >>> has_converged(-21.0, -20.0, tolerance=0.1, floor=0.0)
    True
    >>> has_converged(0.0, 0.0, tolerance=0.1, floor=0.0)
    True
    """
    return abs(new - old) <= tolerance * max(abs(old), floor)


def keeps_limit(cost: float, limit: float, *, tolerance: float) -> bool:
    """Whether the policy adheres to a limit: C-bar <= d + tolerance (none in Algorithm 2, line 6).

    The comparison allows for rounding errors of 1e-9.
    """
    return cost <= limit + tolerance or math.isclose(cost, limit, rel_tol=1e-9)


def next_limit(limit: float, cost: float, deploy_limit: float, *, remaining: int) -> float:
    """Return the limit after one that was kept: max(d_d, C - (C - d_d) / n) with C = min(C-bar, d).

    Algorithm 2, line 7, where C-bar <= d. Written d_d + (C - d_d)(1 - 1 / n), which is the same and is d_d
    exactly when n = 1.

    Args:
        limit: d, possibly infinite.
        cost: C-bar, at least 0.
        deploy_limit: d_d, finite.
        remaining: n, the number of remaining steps; less than 1 counts as 1.

    >>> next_limit(math.inf, 65.0, 5.0, remaining=6)
    55.0
    """
    if limit <= deploy_limit:
        return deploy_limit
    start = min(cost, limit)
    return max(deploy_limit, deploy_limit + (start - deploy_limit) * (1.0 - 1.0 / max(1, remaining)))


def decide(
    old: WindowStatistics,
    new: WindowStatistics,
    *,
    limit: float,
    deploy_limit: float,
    remaining: int,
    config: DynamicConfig,
) -> tuple[float, float]:
    """Return the next limit of one cost, and policy noise, by lines 5 to 10 of Algorithm 2.

    Args:
        old: the window before the last, with this cost only and at least one episode.
        new: the last window, likewise, entirely after the last change.
        limit: d in force.
        deploy_limit: d_d.
        remaining: n of ``next_limit``.
        config: the settings.

    Returns:
        The limit and the noise: eps_pi for an agent that is stuck, else 0.
    """
    if not _have_converged(old, new, config):
        return limit, 0.0
    (cost,), (error,) = new.mean_costs, new.standard_errors
    tolerance = max(error, config.cost_tolerance * max(limit, config.cost_floor))
    if not keeps_limit(cost, limit, tolerance=tolerance):
        return limit, config.policy_noise
    return next_limit(limit, cost, deploy_limit, remaining=remaining), 0.0


def _have_converged(old: WindowStatistics, new: WindowStatistics, config: DynamicConfig) -> bool:
    """Whether the return and the cost have converged (line 5)."""
    return_floor, cost_floor = _floors(old, config)
    (cost,), (before,) = new.mean_costs, old.mean_costs
    return has_converged(
        new.mean_return, old.mean_return, tolerance=config.return_tolerance, floor=return_floor
    ) and has_converged(cost, before, tolerance=config.cost_tolerance, floor=cost_floor)


def is_precise(window: WindowStatistics, config: DynamicConfig) -> bool:
    """Whether the standard errors of a window's means are within the tolerances; the window has one cost.

    s <= eps max(|mean|, floor, standard deviation), s the standard error of the return and of the cost. With
    eps = 0.1 a hundred episodes are always enough. Fewer than ``LEAST_EPISODES`` never are.
    """
    if window.episodes < LEAST_EPISODES:
        return False
    return_floor, cost_floor = _floors(window, config)
    (cost,), (cost_spread,), root = window.mean_costs, window.cost_spreads, math.sqrt(window.episodes)
    return_scale, cost_scale = max(abs(window.mean_return), return_floor), max(cost, cost_floor)
    return (
        window.return_spread <= config.return_tolerance * return_scale * root
        and cost_spread <= config.cost_tolerance * cost_scale * root
    )


def _floors(window: WindowStatistics, config: DynamicConfig) -> tuple[float, float]:
    """Return the least scales for comparing the mean return and the mean cost: the floor, or the spread."""
    (cost_spread,) = window.cost_spreads
    return max(window.return_spread, config.return_floor), max(cost_spread, config.cost_floor)


def steps_left(last: WindowStatistics, *, env_steps: int, train_steps: int, duration: int) -> int:
    """Return the number of steps of ``next_limit`` in the remaining budget, at the last window's pace.

    These are the remaining windows but two, rounded down.

    Args:
        last: the last window.
        env_steps: taken so far.
        train_steps: B.
        duration: of the longest episode, in environment steps over all environments. Windows begin that much
            after a change.

    >>> last = WindowStatistics(1000, episodes=8, mean_return=0.0, mean_costs=(0.0,), cost_scatter=(0.0,))
    >>> [steps_left(last, env_steps=0, train_steps=20_000, duration=duration) for duration in (0, 1000)]
    [18, 8]
    """
    reserve = 2 * last.env_steps + duration
    return (train_steps - env_steps - reserve) // max(1, last.env_steps + duration)
