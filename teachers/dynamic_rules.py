"""The decisions of the dynamic curriculum: lines 5 to 10 of Algorithm 2, as functions of windows.

``recrl.teachers.dynamic`` has the curriculum, and what these functions do where Algorithm 2 has gaps.

Notation: d limits in force, d_d deployment limits, B the training budget in environment steps, b an episode;
C-bar and r-bar the mean episode cost and return of a window; k the number of costs, eps_r, eps_c the paper's
settings.
"""

from __future__ import annotations

import math
from typing import Literal

from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.teachers.dynamic_options import DynamicConfig
from recrl.teachers.windows import WindowStatistics

LEAST_EPISODES = 10  # of a window that grows; a standard error from fewer episodes is itself uncertain


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
        deploy_limit: d_d; infinite for a cost that is never constrained.
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
    limits: CostLimits,
    deploy_limits: CostLimits,
    remaining: int,
    config: DynamicConfig,
) -> CurriculumStep:
    """Return the next step, by lines 5 to 10 of Algorithm 2.

    Args:
        old: the window before the last.
        new: the last window, entirely after the last change.
        limits: d in force, [k].
        deploy_limits: d_d, [k].
        remaining: n of ``next_limit``.
        config: the settings.
    """
    if old.episodes == 0 or new.episodes == 0:
        return CurriculumStep(limits)
    settled = which_converged(old, new, config)
    kept = _kept(new, limits, config)
    if config.dimensions == "joint":
        kept = [all(kept)] * len(limits)
    is_stuck = any(is_settled and not keeps for is_settled, keeps in zip(settled, kept, strict=True))
    lowered = tuple(
        next_limit(limit, cost, deploy, remaining=remaining) if is_settled and keeps else limit
        for limit, cost, deploy, is_settled, keeps in zip(
            limits, new.mean_costs, deploy_limits, settled, kept, strict=True
        )
    )
    return CurriculumStep(CostLimits(lowered), config.policy_noise if is_stuck else 0.0)


def which_converged(old: WindowStatistics, new: WindowStatistics, config: DynamicConfig) -> list[bool]:
    """Whether the return and the cost of each dimension have converged (line 5), [k].

    It is false if a window has no episode. With joint limits, it is the same for all costs.
    """
    if old.episodes == 0 or new.episodes == 0:
        return [False] * len(new.mean_costs)
    return_floor, cost_floors = _floors(old, config)
    return_converged = has_converged(
        new.mean_return, old.mean_return, tolerance=config.return_tolerance, floor=return_floor
    )
    converged = [
        return_converged and has_converged(cost, before, tolerance=config.cost_tolerance, floor=floor)
        for cost, before, floor in zip(new.mean_costs, old.mean_costs, cost_floors, strict=True)
    ]
    return [all(converged)] * len(converged) if config.dimensions == "joint" else converged


def _floors(window: WindowStatistics, config: DynamicConfig) -> tuple[float, tuple[float, ...]]:
    """Return the scales for comparing the mean return and the mean costs: the floor, or the spread."""
    if not config.window_grows:
        return config.return_floor, (config.cost_floor,) * len(window.mean_costs)
    cost_floors = tuple(max(spread, config.cost_floor) for spread in window.cost_spreads)
    return max(window.return_spread, config.return_floor), cost_floors


def is_precise(window: WindowStatistics, config: DynamicConfig) -> bool:
    """Whether the standard errors of a window's means are within the tolerances.

    s <= eps max(|mean|, floor, standard deviation), s the standard error of the return and of each cost. With
    eps = 0.1 a hundred episodes are always enough. Fewer than ``LEAST_EPISODES`` never are.
    """
    if window.episodes < LEAST_EPISODES:
        return False
    return_floor, cost_floors = _floors(window, config)
    root = math.sqrt(window.episodes)
    return_scale = max(abs(window.mean_return), return_floor)
    return window.return_spread <= config.return_tolerance * return_scale * root and all(
        spread <= config.cost_tolerance * max(cost, floor) * root
        for spread, cost, floor in zip(window.cost_spreads, window.mean_costs, cost_floors, strict=True)
    )


def _kept(new: WindowStatistics, limits: CostLimits, config: DynamicConfig) -> list[bool]:
    """Whether each limit is kept, [k]."""
    return [
        keeps_limit(cost, limit, tolerance=_tolerance(limit, error, config))
        for cost, limit, error in zip(new.mean_costs, limits, new.standard_errors, strict=True)
    ]


def _tolerance(limit: float, standard_error: float, config: DynamicConfig) -> float:
    """Return the tolerance by which a mean cost may exceed its limit."""
    match config.adherence_tolerance:
        case "none":
            return 0.0
        case "standard_error":
            return standard_error
        case "relative":
            return max(standard_error, config.cost_tolerance * max(limit, config.cost_floor))


def steps_left(
    last: WindowStatistics,
    *,
    env_steps: int,
    train_steps: int,
    unit: Literal["windows", "episodes"],
    duration: int = 0,
) -> int:
    """Return the number of steps of ``next_limit`` in the remaining budget, at the last window's pace.

    B is in environment steps, and its number of episodes is not known in advance. At the steps and episodes
    of the last window, (B - env steps) / steps windows remain, with that multiple of its episodes. Both are
    rounded down. The last two windows are not counted, nor is the next episode: Algorithm 2 decides before it
    runs episode b, when B - b + 1 episodes remain.

    Args:
        last: the last window.
        env_steps: taken so far.
        train_steps: B.
        unit: of the result.
        duration: of the longest episode, in environment steps over all environments, if windows begin that
            much after a change; else 0.

    >>> last = WindowStatistics(1000, episodes=8, mean_return=0.0, mean_costs=(0.0,), cost_scatter=(0.0,))
    >>> [steps_left(last, env_steps=5500, train_steps=10000, unit=unit) for unit in ("windows", "episodes")]
    [2, 35]
    """
    steps = train_steps - env_steps
    if unit == "episodes":
        return steps * last.episodes // max(1, last.env_steps) - 1
    reserve = 2 * last.env_steps + duration
    return (steps - reserve) // max(1, last.env_steps + duration)
