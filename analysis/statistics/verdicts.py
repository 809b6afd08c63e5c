"""Verdicts on a policy: feasible, solved.

There is one tolerance. Feasible means that every mean cost is at most its limit plus ``tolerance``. This is a
fraction COST_TOLERANCE of the limit, or one standard error of the mean if that is larger. A policy with
softmax outputs cannot meet a limit exactly like the optimum, because each action keeps some probability.
Under a limit of 0 it is COST_TOLERANCE, in episode cost. If only one of many episodes has a cost, the mean
equals its standard error, however large that cost is. So one standard error would allow any such cost.

Solved (the column ``optimal``) means feasible and at most SOLVED_GAP below J*(d_d), if that is known.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

SOLVED_GAP = 0.2  # of the return to J*(d_d)
COST_TOLERANCE = 0.01  # of a limit; in episode cost where the limit is 0
ROUNDING = 1e-9  # of a difference of two returns: 9.5 - 9.3 is more than 0.2


def within_limits(rows: pd.DataFrame) -> pd.Series[bool]:
    """Whether every mean cost is at most its limit plus ``tolerance``.

    Args:
        rows: of ``within_limit``, for every cost.
    """
    within: pd.Series[bool] = pd.Series(True, index=rows.index)
    for i in costs_of(rows):
        within = within & within_limit(rows, i)
    return within


def within_limit(rows: pd.DataFrame, i: str) -> pd.Series[bool]:
    """Whether the mean cost i is at most its limit plus ``tolerance``.

    A missing limit is kept by every policy. A missing cost keeps no limit.

    Args:
        rows: cost_i, deploy_limit_i (NaN if the task lacks it), and cost_i_se if costs are sampled.
        i: index of the cost, as in the columns' names.
    """
    limit = rows[f"deploy_limit_{i}"]
    errors = rows[f"cost_{i}_se"] if f"cost_{i}_se" in rows else pd.Series(0.0, index=rows.index)
    return (rows[f"cost_{i}"] <= limit + tolerance(limit, errors)) | limit.isna()


def exceeded_costs(rows: pd.DataFrame) -> pd.DataFrame:
    """Return by how much each row exceeds its limits.

    Args:
        rows: as for ``within_limit``, for every cost.

    Returns:
        excess_i of every cost (cost minus limit; NaN where the cost is at most its limit plus
        ``tolerance``), with the index of ``rows``.
    """
    excesses = {
        f"excess_{i}": (rows[f"cost_{i}"] - rows[f"deploy_limit_{i}"]).mask(within_limit(rows, i))
        for i in costs_of(rows)
    }
    return pd.DataFrame(excesses, index=rows.index)


def tolerance(limits: pd.Series[float], errors: pd.Series[float]) -> pd.Series[float]:
    """Return the tolerance of a mean cost: COST_TOLERANCE of its limit, or a standard error if larger.

    Args:
        limits: d_d,i; at a limit of 0 the tolerance is COST_TOLERANCE itself.
        errors: standard errors of the mean costs; NaN counts as 0.

    >>> tolerance(pd.Series([25.0, 25.0, 0.0]), pd.Series([0.1, 3.0, 3.0])).round(6).tolist()
    [0.25, 3.0, 0.01]
    """
    is_positive = limits > 0.0
    share = COST_TOLERANCE * limits.where(is_positive, 1.0)
    known = errors.fillna(0.0).where(is_positive, 0.0)
    return pd.Series(np.maximum(share, known) + ROUNDING * (1.0 + limits), index=limits.index)


def solved(rows: pd.DataFrame) -> pd.Series[bool]:
    """Whether a trial is solved: feasible, and at most SOLVED_GAP below a known J*(d_d).

    Args:
        rows: gap, and the columns for ``within_limits``.
    """
    near = (rows["gap"] <= SOLVED_GAP + ROUNDING) & (rows["gap"] > -math.inf)  # NaN is neither
    return near & within_limits(rows)


def tie(optimal_return: float) -> float:
    """How far apart two equal returns may be: SOLVED_GAP where J*(d_d) is known, elsewhere ROUNDING.

    Policies with softmax outputs that have all found one path differ by what other actions keep.

    Args:
        optimal_return: J*(d_d); NaN if it is not known, minus infinity if no policy is feasible.
    """
    return (SOLVED_GAP if math.isfinite(optimal_return) else 0.0) + ROUNDING


def costs_of(rows: pd.DataFrame | pd.Series) -> list[str]:
    """Return each i with a column deploy_limit_i; of one row, with such an entry."""
    names = map(str, rows.columns if isinstance(rows, pd.DataFrame) else rows.index)
    return [name.removeprefix("deploy_limit_") for name in names if name.startswith("deploy_limit_")]


def is_cost(name: str) -> bool:
    """Whether a column is a cost_i itself, not its error, limit or total."""
    return name.startswith("cost_") and name.removeprefix("cost_").isdigit()
