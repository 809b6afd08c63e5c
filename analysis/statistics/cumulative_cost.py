"""Cumulative cost of a training phase against its theoretical bounds: Proposition 1 on a sweep's trials.

Everything is summed over the n policies of the training phase, one expected episode each, as in
``recrl.teachers.bounds``; only ``measured_over_deploy`` is summed over all recorded episodes.

Undiscounted (the unit of all limits here), one row per trial:

    cost_sum         sum_b C_b, the measured mean episode cost of each policy
    limit_sum        sum_b D_b, the limits in force (the cost itself where they were infinite)
    over_limits_sum  cost_sum - limit_sum, the net cost above the limits in force
    over_deploy_sum  cost_sum - n d_d, the net cost above the deployment limit
    overshoot_sum    sum_b max(0, C_b - D_b), the positive parts of the measured means above the limits
    bound            H c_max + sum_{b<n} min(D_b + excess_b, H c_max), an upper bound on the expected cost of
                     the n policies if every update solves CPO's problem: policy b + 1 solves the problem
                     with limit D_b (``bounds.undiscounted_excess``), the first policy solves none
    ceiling_sum      n H c_max, the trivial bound of n policies

In the two net costs, policies below a limit count against policies above it, so they may be negative. In
``overshoot_sum`` they do not, but it is biased upwards. C_b is a mean of few episodes, so the sum is far
above 0 even if the expected cost of every policy is that of its limit.

    measured_over_deploy    sum_b E_b (C_b - d_d), the net cost of all E_b recorded episodes of each policy
                            above the deployment limit

If no episode ends while a policy is in use, its C_b is that of the policy before. At the beginning of
training it is that of the first policy with an episode. ``metrics.training_totals`` counts the others.

Discounted, as in the paper; do not add these to the above:

    discounted_excess_sum   the sum over b < n of Lemma 1's sqrt(2 delta_b) gamma eps_b / (1 - gamma)^2
    discounted_bound        H c_max + sum_{b<n} min(D_b + discounted excess_b, H c_max): Proposition 1 for the
                            limits in force

delta_b is the measured mean KL divergence of the update from policy b, gamma the agent's own. eps_b is at
most c_max / (1 - gamma). If the agent reports its largest cost advantage in the batch
(``cost_advantage_max_i``) and it is smaller, that is used: an estimate without proof. The undiscounted
advantages are not measured. H c_max is a crude bound on them, so the undiscounted bound is near the trivial
one. A policy's discounted cost is not recorded, but at most its undiscounted cost. So a run with a cost_sum
within ``discounted_bound`` satisfies Proposition 1.

Updates under an infinite limit (during the measurement of d_t) have only the trivial bound. If horizon and
largest cost are unknown, there is no trivial bound. Then the first policy counts with its measured cost, and
only ``discounted_bound`` is known.

Notation: b policies, n their number, C_b, D_b cost and limit, d_t, d_d training and deployment limit, H
horizon, c_max largest cost of a step, delta, eps, gamma as in ``bounds``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from recrl.analysis.data.exact_values import finite_model
from recrl.analysis.data.labels import GROUP, KEY
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.statistics.metrics import with_finished_training
from recrl.environments.cmdp import Floats, Phase
from recrl.teachers.bounds import (
    DECAYS,
    discounted_excess,
    largest_train_limit,
    undiscounted_excess,
)


@dataclass(frozen=True)
class TaskSizes:
    """Quantities that bound any policy's cost on a finite task.

    Attributes:
        horizon: H, largest number of steps of an episode.
        largest_cost: c_max, of a step.
    """

    horizon: int
    largest_cost: float

    @property
    def ceiling(self) -> float:
        """H c_max, the largest possible cost of an episode."""
        return self.horizon * self.largest_cost


def policy_costs(
    updates: pd.DataFrame, *, cost: int, sizes: TaskSizes | None, discount: float | None
) -> pd.DataFrame:
    """Return measured cost and bounds of each policy of one trial's training phase: one row per policy.

    Args:
        updates: of the trial's training phase.
        cost: i, index of the cost.
        sizes: of the task, None if unknown.
        discount: gamma of a CPO agent; None for others, which have no bounds.

    Returns:
        end_step, cost, limit, ceiling, bound, discounted_excess (of the update that made the policy, 0 for
        the first), discounted_bound: the summands of the module's sums; NaN if unknown.
    """
    costs = updates[f"cost_{cost}"].ffill().bfill().to_numpy(np.float64)
    limits = updates[f"limit_{cost}"].to_numpy(np.float64)
    ceiling = math.inf if sizes is None else sizes.ceiling
    first = costs[0] if sizes is None else ceiling

    def bounded(excesses: Sequence[float]) -> Floats:
        return np.array([first, *np.minimum(limits[:-1] + np.array(excesses), ceiling)])

    policies = pd.DataFrame({"end_step": updates["end_step"].to_numpy(), "cost": costs, "limit": limits})
    policies["ceiling"] = math.nan if sizes is None else ceiling
    policies[["bound", "discounted_excess", "discounted_bound"]] = math.nan
    if discount is None or "kl" not in updates:
        return policies
    divergences = updates["kl"].to_numpy(np.float64)[:-1].clip(min=0.0).tolist()
    advantages = _advantages(updates, cost, sizes, discount)[:-1].tolist()
    discounted = [
        discounted_excess(kl, eps, discount=discount) for kl, eps in zip(divergences, advantages, strict=True)
    ]
    policies["discounted_excess"] = [0.0, *discounted]
    policies["discounted_bound"] = bounded(discounted)
    if sizes is not None:
        excesses = [undiscounted_excess(kl, ceiling, horizon=sizes.horizon) for kl in divergences]
        policies["bound"] = bounded(excesses)
    return policies


def _advantages(updates: pd.DataFrame, cost: int, sizes: TaskSizes | None, discount: float) -> Floats:
    """Return eps of each update, [updates], in discounted cost.

    It is the largest possible value, infinite if unknown, or the agent's measured one if smaller.
    """
    largest = math.inf if sizes is None or discount == 1.0 else sizes.largest_cost / (1.0 - discount)
    name = f"cost_advantage_max_{cost}"
    seen = updates[name].to_numpy(np.float64) if name in updates else np.full(len(updates), math.inf)
    return np.asarray(np.fmin(seen, largest))


def cumulative_costs(sweep: Sweep, *, cost: int | Mapping[str, int] = 0) -> pd.DataFrame:
    """Return measured sums and bounds: one row per trial with a finished training phase.

    Args:
        sweep: the frames.
        cost: i, index of the cost; or the index in each task that has the cost, by the task's label.

    Returns:
        KEY, policies (n), episodes_per_policy, train_limit (the d_t in force at the start of the
        curriculum), deploy_limit, and the quantities in the module's docstring; NaN if unknown, bounds also
        for agents other than CPO.
    """
    trained = with_finished_training(sweep)
    runs = training_runs(sweep)
    lines = []
    for _, trial in trained.iterrows():
        key = tuple(trial[name] for name in KEY)
        i = cost if isinstance(cost, int) else cost.get(str(trial["task"]))
        if i is None or math.isnan(trial[f"deploy_limit_{i}"]):
            continue
        start = trial[f"start_limit_{i}"]
        given = trial[f"train_limit_{i}"] if math.isnan(start) else start
        deploy = float(trial[f"deploy_limit_{i}"])
        lines.append(
            dict(zip(KEY, key, strict=True))
            | {"train_limit": float(given), "deploy_limit": deploy}
            | {"episodes_per_policy": float(runs[key]["episodes"].mean())}
            | {"measured_over_deploy": _net_cost(runs[key], i, deploy)}
            | _sums(policies_of(sweep, trial, runs[key], cost=i), deploy)
        )
    rows = pd.DataFrame(lines)
    for name in KEY[:3] if len(rows) else ():
        rows[name] = rows[name].astype(sweep.trials[name].dtype)
    return rows


def admissible_limits(rows: pd.DataFrame, sweep: Sweep, *, budget: float) -> pd.DataFrame:
    """Return the largest d_t within a budget of cost above d_d: one row per GROUP with a bound.

    This is the inverse of Proposition 1 (``bounds.largest_train_limit``). The proven excess of an update is
    too large for any budget. So the measured mean overshoot of the group's worst run is used. With few
    episodes per policy it is too large (see the module), and the returned limit too small.

    Args:
        rows: of ``cumulative_costs``.
        sweep: of these rows.
        budget: expected net cost above d_d, summed over all episodes of a training phase, at least 0.

    Returns:
        GROUP, policies, episodes_per_policy, overshoot (assumed, per policy); used_train_limit (the largest
        of the runs); measured_over_deploy (the largest of the runs); largest_train_limit (NaN if
        d_t = d_d exceeds the budget, infinite if d_t does not matter).

    Raises:
        ValueError: the budget is negative.
    """
    if not budget >= 0.0:
        raise ValueError(f"budget: must be at least 0, got {budget:g}")
    names = {tuple(group): str(name) for *group, name in sweep.trials[[*GROUP, "method_name"]].to_numpy()}
    lines = []
    for group, runs in rows.groupby(list(GROUP), observed=True, sort=False):
        if (curriculum := names[group]) not in DECAYS:
            continue
        policies, episodes = int(runs["policies"].iloc[0]), float(runs["episodes_per_policy"].mean())
        if not episodes:  # no episode finished in the training phase
            continue
        overshoot = float((runs["overshoot_sum"] / runs["policies"]).max())
        deploy = float(runs["deploy_limit"].iloc[0])
        allowed = policies * deploy + budget / episodes
        try:
            limit = largest_train_limit(curriculum, allowed, deploy, excesses=[overshoot] * policies)
        except ValueError:  # less than the bound for d_t = d_d
            limit = math.nan
        lines.append(
            dict(zip(GROUP, group, strict=True))
            | {"policies": policies, "episodes_per_policy": episodes, "overshoot": overshoot}
            | {"used_train_limit": float(runs["train_limit"].max())}
            | {"measured_over_deploy": float(runs["measured_over_deploy"].max())}
            | {"largest_train_limit": limit}
        )
    return pd.DataFrame(lines)


def training_runs(sweep: Sweep) -> dict[Any, pd.DataFrame]:
    """Return the updates of every trial's training phase, by KEY."""
    updates = sweep.updates[sweep.updates["phase"] == Phase.TRAINING.value]
    return dict(iter(updates.groupby(list(KEY), observed=True)))


def policies_of(sweep: Sweep, trial: pd.Series, updates: pd.DataFrame, *, cost: int) -> pd.DataFrame:
    """Compute ``policy_costs`` of a trial.

    Args:
        sweep: of the trial.
        trial: its row of ``sweep.trials``.
        updates: of its training phase.
        cost: i, index of the cost.
    """
    sizes = task_sizes(str(trial["task_name"]), sweep.task_options[str(trial["task"])], cost)
    return policy_costs(updates, cost=cost, sizes=sizes, discount=_discount(sweep, trial))


def is_bounded(sweep: Sweep, agent: str, *, cost: int) -> bool:
    """Whether any bound on the cost of an agent's trials is known: CPO's, or the trivial one of finite tasks.

    Args:
        sweep: of the trials.
        agent: the agent's label.
        cost: i, index of the cost.
    """
    trials = sweep.trials[(sweep.trials["agent"] == agent) & sweep.trials[f"deploy_limit_{cost}"].notna()]
    return bool((trials["agent_name"] == "cpo").any()) or any(
        task_sizes(str(name), sweep.task_options[str(task)], cost) is not None
        for task, name in trials[["task", "task_name"]].drop_duplicates().itertuples(index=False)
    )


def task_sizes(name: str, options: Mapping[str, Any], cost: int) -> TaskSizes | None:
    """Return horizon and largest cost of a step of a finite task; None for others."""
    model = finite_model(name, options)
    return None if model is None else TaskSizes(model.horizon, float(model.costs[:, :, cost].max()))


def _discount(sweep: Sweep, trial: pd.Series) -> float | None:
    """Return the discount gamma of a CPO agent, None for others: Lemma 1 is not about them."""
    options = sweep.agent_options[str(trial["task"]), str(trial["agent"])]
    discount = options.get("discount", math.nan)
    if trial["agent_name"] != "cpo":
        return None
    return float(discount) if isinstance(discount, int | float) else math.nan


def _net_cost(updates: pd.DataFrame, cost: int, deploy: float) -> float:
    """Return ``measured_over_deploy`` of a trial; updates without an episode have no cost and add none."""
    return float((updates["episodes"] * (updates[f"cost_{cost}"] - deploy)).sum())


def _sums(policies: pd.DataFrame, deploy: float) -> dict[str, float]:
    """Sum over the policies of a trial."""
    costs, limits = policies["cost"].to_numpy(np.float64), policies["limit"].to_numpy(np.float64)
    limits = np.where(np.isfinite(limits), limits, costs)
    return {
        "policies": len(costs),
        "cost_sum": float(costs.sum()),
        "limit_sum": float(limits.sum()),
        "over_limits_sum": float((costs - limits).sum()),
        "over_deploy_sum": float((costs - deploy).sum()),
        "overshoot_sum": float(np.maximum(costs - limits, 0.0).sum()),
        "bound": _sum(policies["bound"]),
        "ceiling_sum": _sum(policies["ceiling"]),
        "discounted_excess_sum": _sum(policies["discounted_excess"]),
        "discounted_bound": _sum(policies["discounted_bound"]),
    }


def _sum(values: pd.Series[float]) -> float:
    """Sum, or return NaN if a value is unknown or infinite."""
    total = math.fsum(values) if np.isfinite(values).all() else math.nan
    return float(total)
