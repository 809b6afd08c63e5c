"""What a trial achieved: functions from tables to tables.

A trial's outcome is measured three ways, never mixed (``Measure``). The design goes on learning in
deployment, as the paper's curves show, so the deployment phase averages over policies; the frozen policy is
the one a user would take away.

Feasible means cost_i <= d_d,i for every i, of the sample means, without tolerance. ``feasible_within_se``
allows one standard error over the trial's episodes. At a cost of exactly d_d in expectation the first is a
coin's toss, which is why both are reported.

Where J*(d_d) is known, ``optimal`` says whether a trial has found it: within OPTIMAL_GAP of the return at
costs within d_d + OPTIMAL_EXCESS.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import GROUP, KEY
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.statistics.intervals import (
    Interval,
    improvement_interval,
    interquartile_mean,
    mean_and_standard_error,
    paired_difference,
    stratified_bootstrap,
    wilson_interval,
)
from recrl.environments.cmdp import Phase
from recrl.orchestrator.spec import TrialState

OPTIMAL_GAP = 0.2  # of the return to J*(d_d)
OPTIMAL_EXCESS = 0.05  # of each mean cost over d_d
ROUNDING = 1e-9  # of a difference of two returns: 9.5 - 9.3 is more than 0.2


class Measure(StrEnum):
    """The episodes that a trial's outcome is averaged over."""

    DEPLOYMENT = "deployment"
    STOCHASTIC = "stochastic"
    DETERMINISTIC = "deterministic"

    @property
    def description(self) -> str:
        """What it is, for captions."""
        return {
            Measure.DEPLOYMENT: "all episodes of the deployment phase, in which learning goes on",
            Measure.STOCHASTIC: "the frozen final policy, sampled",
            Measure.DETERMINISTIC: "the frozen final policy, most probable actions",
        }[self]


def outcomes(sweep: Sweep) -> pd.DataFrame:
    """What every complete trial achieved: a row a trial and measure.

    Trials that are not complete are left out: half a deployment phase is no outcome.

    Returns:
        KEY, measure, episodes, episode_return, episode_return_se, cost_i, cost_i_se (standard errors over
        the trial's episodes), deploy_limit_i, optimal_return, gap (J*(d_d) minus the return; only an
        honest score where the trial is feasible), feasible, feasible_within_se, optimal (False where J* is
        not known).
    """
    costs = [f"cost_{i}" for i in range(sweep.num_costs)]
    measured = pd.concat([_deployment(sweep, costs), _frozen(sweep, costs)], ignore_index=True)
    complete = sweep.trials[sweep.trials["status"] == TrialState.COMPLETE.value]
    limits = [f"deploy_limit_{i}" for i in range(sweep.num_costs)]
    rows = measured.merge(complete[[*KEY, *limits, "optimal_return"]], on=list(KEY))
    rows["gap"] = rows["optimal_return"] - rows["episode_return"]
    rows["feasible"] = within_limits(rows)
    rows["feasible_within_se"] = within_limits(rows, standard_errors=1.0)
    rows["optimal"] = optimal(rows)
    order = {measure.value: position for position, measure in enumerate(Measure)}
    by_measure = rows["measure"].map(order).rename("_order")
    rows = rows.assign(_order=by_measure).sort_values([*KEY, "_order"], kind="stable", ignore_index=True)
    return rows.drop(columns="_order")


def within_limits(
    rows: pd.DataFrame, *, standard_errors: float = 0.0, excess: float = 0.0
) -> pd.Series[bool]:
    """Whether every mean cost is at most its limit plus a tolerance; costs that a task lacks are.

    Args:
        rows: cost_i, deploy_limit_i (NaN where the task lacks it), and cost_i_se if it is asked for.
        standard_errors: the tolerance, in standard errors of the mean (0 where they are not known).
        excess: more of it, in episode cost.
    """
    within = pd.Series(True, index=rows.index)
    for limit in (str(name) for name in rows if str(name).startswith("deploy_limit_")):
        cost = limit.removeprefix("deploy_limit_")
        bounds = rows[limit] + excess
        if standard_errors:
            bounds = bounds + standard_errors * rows[f"cost_{cost}_se"].fillna(0.0)
        within &= (rows[f"cost_{cost}"] <= bounds) | rows[limit].isna()
    return within


def optimal(rows: pd.DataFrame) -> pd.Series[bool]:
    """Whether a gap to J*(d_d) is known and small and the costs are within d_d; the module says how far.

    Args:
        rows: gap, and what ``within_limits`` takes.
    """
    return (rows["gap"] <= OPTIMAL_GAP + ROUNDING) & within_limits(rows, excess=OPTIMAL_EXCESS)


def training_totals(sweep: Sweep) -> pd.DataFrame:
    """What relaxed training cost: a row a trial whose training phase is done.

    Returns:
        KEY, episodes, steps, cost_i_total (the paper's SUM-J_C,i: all cost incurred in training, within
        the limit or not), excess_i_total (the part of it above d_d, episode by episode), updates_over_i
        (policy updates whose mean cost was above the limit in force).
    """
    trained = sweep.trials[sweep.trials["env_steps"] >= sweep.trials["boundary_step"]]
    phases = sweep.phases[sweep.phases["phase"] == Phase.TRAINING.value]
    totals = [f"{kind}_{i}_total" for i in range(sweep.num_costs) for kind in ("cost", "excess")]
    rows = phases[[*KEY, "episodes", "steps", *totals]].merge(trained[list(KEY)], on=list(KEY))
    updates = sweep.updates[sweep.updates["phase"] == Phase.TRAINING.value]
    for i in range(sweep.num_costs):
        over = (updates[f"cost_{i}"] > updates[f"limit_{i}"]).rename(f"updates_over_{i}")
        counts = over.groupby([updates[name] for name in KEY], observed=True).sum().reset_index()
        rows = rows.merge(counts, on=list(KEY))
    return rows


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Outcomes averaged over seeds: a row a task, student, method and measure.

    Args:
        rows: of ``outcomes``.

    Returns:
        GROUP, measure, seeds, then mean and standard error (``_se``) of episode_return, cost_i and gap,
        deploy_limit_i, optimal_return, feasible_seeds, feasible_share with Wilson's 95% interval
        (feasible_low, feasible_high), feasible_within_se_seeds, and optimal_seeds with Wilson's interval of
        their share (optimal_low, optimal_high).
    """
    names = [str(name) for name in rows]
    averaged = [name for name in names if name in ("episode_return", "gap") or is_cost(name)]
    constant = [name for name in names if name.startswith("deploy_limit_") or name == "optimal_return"]
    lines = []
    for group, chosen in rows.groupby([*GROUP, "measure"], observed=True, sort=False):
        line: dict[str, Any] = dict(zip((*GROUP, "measure"), group, strict=True))
        line["seeds"] = len(chosen)
        for name in averaged:
            line[name], line[f"{name}_se"] = mean_and_standard_error(chosen[name].to_numpy(np.float64))
        line |= {name: chosen[name].iloc[0] for name in constant}
        share, best = (
            wilson_interval(int(chosen[name].sum()), len(chosen)) for name in ("feasible", "optimal")
        )
        line |= {
            "feasible_seeds": int(chosen["feasible"].sum()),
            "feasible_share": share.estimate,
            "feasible_low": share.low,
            "feasible_high": share.high,
            "feasible_within_se_seeds": int(chosen["feasible_within_se"].sum()),
            "optimal_seeds": int(chosen["optimal"].sum()),
            "optimal_low": best.low,
            "optimal_high": best.high,
        }
        lines.append(line)
    return pd.DataFrame(lines)


def robust_summary(rows: pd.DataFrame, generator: np.random.Generator) -> pd.DataFrame:
    """Interquartile means of the return with 95% bootstrap intervals: a row a GROUP and measure.

    Args:
        rows: of ``outcomes``.
        generator: draws the resamples.

    Returns:
        GROUP, measure, seeds, iqm, iqm_low, iqm_high, too_few_seeds (the interval is then too short).
    """
    lines = []
    for group, chosen in rows.groupby([*GROUP, "measure"], observed=True, sort=False):
        line: dict[str, Any] = dict(zip((*GROUP, "measure"), group, strict=True))
        scores = chosen["episode_return"].to_numpy(np.float64)[:, None]
        interval = stratified_bootstrap(scores, interquartile_mean, generator)
        lines.append(
            line
            | {"seeds": interval.runs, "iqm": interval.estimate}
            | {"iqm_low": interval.low, "iqm_high": interval.high, "too_few_seeds": interval.is_small}
        )
    return pd.DataFrame(lines)


def comparisons(
    rows: pd.DataFrame, generator: np.random.Generator, *, baseline: str = "none"
) -> pd.DataFrame:
    """Every method against the student without a curriculum: a row a GROUP (but the baseline) and measure.

    Args:
        rows: of ``outcomes``.
        generator: draws the resamples.
        baseline: the method that the others are compared to.

    Returns:
        GROUP, measure, pairs (seeds that both have), then mean paired differences to the baseline with
        Student's 95% interval: return_difference, _low, _high, and the same for cost_i_difference; then
        improvement, the probability that a run returns more than one of the baseline's, with its
        bootstrap interval _low, _high, and too_few_seeds (that interval is then too short).
    """
    costs = [str(name) for name in rows if is_cost(str(name))]
    lines = []
    for (task, agent, method, measure), chosen in rows.groupby(
        [*GROUP, "measure"], observed=True, sort=False
    ):
        same = (rows["task"] == task) & (rows["agent"] == agent) & (rows["measure"] == measure)
        others = rows[same & (rows["method"] == baseline)]
        if method == baseline or not len(others):
            continue
        pairs = chosen.merge(others, on="seed", suffixes=("", "_base"))
        line: dict[str, Any] = {"task": task, "agent": agent, "method": method, "measure": measure}
        line["pairs"] = len(pairs)
        for name, column in (("return", "episode_return"), *((cost, cost) for cost in costs)):
            difference = paired_difference(
                pairs[column].to_numpy(np.float64), pairs[f"{column}_base"].to_numpy(np.float64)
            )
            line |= _ends(f"{name}_difference", difference)
        improvement = improvement_interval(
            chosen["episode_return"].to_numpy(np.float64)[:, None],
            others["episode_return"].to_numpy(np.float64)[:, None],
            generator,
        )
        lines.append(line | _ends("improvement", improvement) | {"too_few_seeds": improvement.is_small})
    return pd.DataFrame(lines)


def _ends(name: str, interval: Interval) -> dict[str, float]:
    return {name: interval.estimate, f"{name}_low": interval.low, f"{name}_high": interval.high}


def is_cost(name: str) -> bool:
    """Whether a column is a cost_i itself, not its error, limit or total."""
    return name.startswith("cost_") and name.removeprefix("cost_").isdigit()


def _deployment(sweep: Sweep, costs: list[str]) -> pd.DataFrame:
    chosen = sweep.phases[sweep.phases["phase"] == Phase.DEPLOYMENT.value]
    rows = chosen[[*KEY, "episodes"]].assign(measure=Measure.DEPLOYMENT.value)
    for name in ("episode_return", *costs):
        rows[name] = chosen[name]
        rows[f"{name}_se"] = chosen[f"{name}_std"] / np.sqrt(chosen["episodes"].astype(np.float64))
    return rows


def _frozen(sweep: Sweep, costs: list[str]) -> pd.DataFrame:
    values = sweep.evaluations.rename(columns={"policy": "measure"})
    grouped = values.groupby([*KEY, "measure"], observed=True)
    rows = grouped.size().rename("episodes").reset_index()
    for name in ("episode_return", *costs):
        statistics = grouped[name].agg(["mean", "sem"]).reset_index()
        rows[name], rows[f"{name}_se"] = statistics["mean"], statistics["sem"]
    return rows
