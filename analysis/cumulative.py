"""What a training phase cost beside what theory allows: Proposition 1 on the trials of a sweep.

Everything is summed over the n policies of the training phase, one expected episode each, as in
``recrl.teachers.bounds``; a trial that collects E episodes with each policy costs E times as much.

Undiscounted (the unit of all limits here), a row a trial:

    cost_sum         sum_b C_b, the measured mean episode cost of each policy
    limit_sum        sum_b D_b, the limits that were in force (the cost itself where they were infinite)
    overshoot_sum    sum_b max(0, C_b - D_b), what the student really went over them
    violation_sum    sum_b max(0, C_b - d_d), what relaxing really cost
    bound            H c_max + sum_{b<n} min(D_b + excess_b, H c_max), what the n policies are expected to
                     cost at most if every update solves CPO's problem: policy b + 1 is the answer to the
                     problem with limit D_b (``bounds.undiscounted_excess``), the first one is nobody's
    ceiling_sum      n H c_max, what n policies can cost at all

Discounted, never to be added to the above:

    discounted_excess_sum   the sum over b of Lemma 1's sqrt(2 delta_b) gamma eps / (1 - gamma)^2

delta_b is the mean KL divergence that the trial measured of the update from policy b. eps, the largest
advantage, is not measured: H c_max and c_max / (1 - gamma) bound it. They are crude, and so the proven bound
is near the ceiling; the overshoot is what can be planned with. Updates under an infinite limit (a d_t that
is still being measured) have no bound but the ceiling.

Letters: b policies, n their number, C_b, D_b cost and limit, d_t, d_d training and deployment limit, H
horizon, c_max largest cost of a step, delta, eps, gamma as in ``bounds``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from recrl.analysis.frames import GROUP, KEY, Sweep
from recrl.analysis.tables import number
from recrl.environments.cmdp import Phase
from recrl.environments.finite_cmdp import FiniteVectorEnv
from recrl.environments.plugins import UnknownNameError
from recrl.environments.registry import find_task, make_vector
from recrl.orchestrator.errors import RecrlError
from recrl.teachers.bounds import (
    MEAN_WEIGHTS,
    discounted_excess,
    largest_train_limit,
    undiscounted_excess,
)


def cumulative_costs(sweep: Sweep, *, cost: int = 0) -> pd.DataFrame:
    """Measured sums and bounds: a row a trial whose training phase is done.

    Args:
        sweep: the frames.
        cost: i, which cost.

    Returns:
        KEY, policies (n), episodes_per_policy, train_limit (the d_t in force at the start of the
        curriculum), deploy_limit, and the quantities that the module's docstring lists; NaN where horizon
        or largest cost of a step are unknown, and the two that Lemma 1 is about also for students but CPO.
    """
    trained = sweep.trials[sweep.trials["env_steps"] >= sweep.trials["boundary_step"]]
    updates = sweep.updates[sweep.updates["phase"] == Phase.TRAINING.value]
    runs = {key: rows for key, rows in updates.groupby(list(KEY), observed=True)}
    lines = []
    for _, trial in trained[trained[f"deploy_limit_{cost}"].notna()].iterrows():
        key = tuple(trial[name] for name in KEY)
        sizes = task_sizes(str(trial["task_name"]), sweep.task_options[str(trial["task"])], cost)
        start = trial[f"start_limit_{cost}"]
        given = trial[f"train_limit_{cost}"] if math.isnan(start) else start
        deploy = float(trial[f"deploy_limit_{cost}"])
        lines.append(
            dict(zip(KEY, key, strict=True))
            | {"train_limit": float(given), "deploy_limit": deploy}
            | _sums(runs[key], cost, deploy)
            | _bounds(runs[key], cost, sizes, _discount(sweep, trial))
        )
    rows = pd.DataFrame(lines)
    for name in KEY[:3] if len(rows) else ():
        rows[name] = rows[name].astype(sweep.trials[name].dtype)
    return rows


def admissible_limits(rows: pd.DataFrame, sweep: Sweep, *, budget: float) -> pd.DataFrame:
    """The largest d_t that a budget of cumulative violation allows: a row a GROUP with a bound.

    The inverse of Proposition 1 (``bounds.largest_train_limit``). The excess of an update is not the proven
    one, which allows nothing, but the mean overshoot that the group's runs measured, the worst run's.

    Args:
        rows: of ``cumulative_costs``.
        sweep: the same.
        budget: expected cost above d_d, summed over all episodes of a training phase, at least 0.

    Returns:
        GROUP, policies, episodes_per_policy, overshoot (assumed, per policy), used_train_limit (the
        largest of the runs'), measured_violation (of the worst run, all its episodes),
        largest_train_limit (NaN where d_t = d_d already exceeds the budget, infinite where d_t does not
        matter).
    """
    if not budget >= 0.0:
        raise RecrlError(f"--budget: must be at least 0, got {budget:g}")
    names = {str(label): str(name) for label, name in sweep.trials[["method", "method_name"]].to_numpy()}
    lines = []
    for group, runs in rows.groupby(list(GROUP), observed=True, sort=False):
        if (curriculum := names[str(group[2])]) not in MEAN_WEIGHTS:
            continue
        policies, episodes = int(runs["policies"].iloc[0]), float(runs["episodes_per_policy"].mean())
        overshoot = float((runs["overshoot_sum"] / runs["policies"]).max())
        deploy = float(runs["deploy_limit"].iloc[0])
        allowed = policies * deploy + budget / episodes
        try:
            limit = largest_train_limit(
                curriculum, allowed, deploy, excesses=[overshoot] * policies, clock="start"
            )
        except ValueError:  # less than what d_t = d_d costs
            limit = math.nan
        lines.append(
            dict(zip(GROUP, group, strict=True))
            | {"policies": policies, "episodes_per_policy": episodes, "overshoot": overshoot}
            | {"used_train_limit": float(runs["train_limit"].max())}
            | {"measured_violation": float((runs["violation_sum"] * runs["episodes_per_policy"]).max())}
            | {"largest_train_limit": limit}
        )
    return pd.DataFrame(lines)


def bound_table(rows: pd.DataFrame) -> pd.DataFrame:
    """The sums of ``cumulative_costs`` as text: a row a GROUP, means over its runs, undiscounted."""
    lines = []
    for group, runs in rows.groupby(list(GROUP), observed=True, sort=False):
        line = {name: str(label) for name, label in zip(GROUP, group, strict=True)}
        line |= {"runs": str(len(runs)), "policies": str(int(runs["policies"].iloc[0]))}
        for title, name in (
            ("cost", "cost_sum"),
            ("limits", "limit_sum"),
            ("over limits", "overshoot_sum"),
            ("over d_d", "violation_sum"),
            ("bound for CPO", "bound"),
            ("ceiling", "ceiling_sum"),
        ):
            line[title] = number(float(runs[name].mean()))
        lines.append(line)
    return pd.DataFrame(lines)


def admissible_table(rows: pd.DataFrame) -> pd.DataFrame:
    """The limits of ``admissible_limits`` as text."""
    lines = []
    for _, row in rows.iterrows():
        limit = float(row["largest_train_limit"])
        lines.append(
            {name: str(row[name]) for name in GROUP}
            | {"overshoot a policy": number(row["overshoot"])}
            | {"violation of the worst run": number(row["measured_violation"])}
            | {"its d_t": number(row["used_train_limit"])}
            | {"largest d_t": "any" if math.isinf(limit) else "none" if math.isnan(limit) else number(limit)}
        )
    return pd.DataFrame(lines)


def task_sizes(name: str, options: Mapping[str, Any], cost: int) -> tuple[int, float] | None:
    """Horizon and largest cost of a step of a finite task; None for others."""
    try:
        if find_task(name).optimum is None:  # no finite task is without, and others can be slow to build
            return None
    except UnknownNameError:  # not installed here
        return None
    environment = make_vector(name, 1, options=options)
    if not isinstance(environment, FiniteVectorEnv):
        return None
    model = environment.finite_cmdp()
    return model.horizon, float(model.costs[:, :, cost].max())


def _discount(sweep: Sweep, trial: pd.Series) -> float | None:
    """The discount gamma of a CPO student, None for others: Lemma 1 is not about them."""
    options = sweep.agent_options[str(trial["agent"])]
    return float(options.get("discount", math.nan)) if trial["agent_name"] == "cpo" else None


def _sums(updates: pd.DataFrame, cost: int, deploy: float) -> dict[str, float]:
    """What was measured; a policy of which no episode ended has the cost of the one before it."""
    costs = updates[f"cost_{cost}"].ffill().bfill().to_numpy(np.float64)
    limits = updates[f"limit_{cost}"].to_numpy(np.float64)
    return {
        "policies": len(costs),
        "episodes_per_policy": float(updates["episodes"].mean()),
        "cost_sum": float(costs.sum()),
        "limit_sum": float(np.where(np.isfinite(limits), limits, costs).sum()),
        "overshoot_sum": float(np.maximum(costs - limits, 0.0).sum()),
        "violation_sum": float(np.maximum(costs - deploy, 0.0).sum()),
    }


def _bounds(
    updates: pd.DataFrame, cost: int, sizes: tuple[int, float] | None, discount: float | None
) -> dict[str, float]:
    """What is proven of the same policies."""
    line = dict.fromkeys(("bound", "ceiling_sum", "discounted_excess_sum"), math.nan)
    if sizes is None:
        return line
    horizon, largest = sizes
    ceiling = horizon * largest
    line["ceiling_sum"] = ceiling * len(updates)
    if discount is None or "kl" not in updates:
        return line
    divergences = updates["kl"].to_numpy(np.float64)[:-1].clip(min=0.0)
    limits = updates[f"limit_{cost}"].to_numpy(np.float64)[:-1]
    excesses = np.array([undiscounted_excess(kl, ceiling, horizon=horizon) for kl in divergences])
    line["bound"] = ceiling + float(np.minimum(limits + excesses, ceiling).sum())
    advantage = largest / (1.0 - discount)
    line["discounted_excess_sum"] = math.fsum(
        discounted_excess(kl, advantage, discount=discount) for kl in divergences
    )
    return line
