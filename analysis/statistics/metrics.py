"""Outcomes of trials: functions from tables to tables.

A trial's outcome has three separate measures (``Measure``). Learning goes on in the deployment phase, so that
phase averages over policies. The final policy is the result of training. Its values are exact if the task is
finite and its table was recorded; otherwise they are means over episodes.

``recrl.analysis.statistics.verdicts`` defines feasible and solved.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import GROUP, KEY
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.statistics.intervals import (
    interquartile_mean,
    mean_and_standard_error,
    stratified_bootstrap,
    wilson_interval,
)
from recrl.analysis.statistics.verdicts import exceeded_costs, is_cost, solved, within_limits
from recrl.environments.cmdp import Phase
from recrl.orchestrator.spec import TrialStatus


class Measure(StrEnum):
    """The episodes or policies that an outcome is averaged over."""

    DEPLOYMENT = "deployment"
    STOCHASTIC = "stochastic"
    DETERMINISTIC = "deterministic"

    @property
    def description(self) -> str:
        """Description for captions."""
        return {
            Measure.DEPLOYMENT: "the deployment phase (learning goes on)",
            Measure.STOCHASTIC: "the final policy, stochastic",
            Measure.DETERMINISTIC: "the final policy, deterministic",
        }[self]


def outcomes(sweep: Sweep) -> pd.DataFrame:
    """Return the outcomes of all complete trials: one row per trial and measure.

    Incomplete trials are left out.

    Returns:
        KEY, measure, episodes, exact (whether computed, not sampled), episode_return, episode_return_se,
        cost_i, cost_i_se (standard errors over the trial's episodes, 0 where exact), trial_id, cpu_seconds
        (of the trial: MLflow tells its outcome from that of an earlier run), deploy_limit_i, optimal_return,
        gap (J*(d_d) minus the return; the regret of a feasible trial), feasible, optimal (solved; False where
        J* is not known), excess_i (of ``exceeded_costs``).
    """
    costs = [f"cost_{i}" for i in range(sweep.num_costs)]
    final = _with_exact(_frozen(sweep, costs), sweep.exact)
    measured = pd.concat([_deployment(sweep, costs), final], ignore_index=True)
    complete = sweep.trials[sweep.trials["status"] == TrialStatus.COMPLETE.value]
    limits = [f"deploy_limit_{i}" for i in range(sweep.num_costs)]
    rows = measured.merge(
        complete[[*KEY, "trial_id", "cpu_seconds", *limits, "optimal_return"]], on=list(KEY)
    )
    rows["gap"] = rows["optimal_return"] - rows["episode_return"]
    rows["feasible"] = within_limits(rows)
    rows["optimal"] = solved(rows)
    rows = rows.join(exceeded_costs(rows))
    order = {measure.value: position for position, measure in enumerate(Measure)}
    by_measure = rows["measure"].map(order).rename("_order")
    rows = rows.assign(_order=by_measure).sort_values([*KEY, "_order"], kind="stable", ignore_index=True)
    return rows.drop(columns="_order")


def with_finished_training(sweep: Sweep) -> pd.DataFrame:
    """Return the rows of ``sweep.trials`` whose saved updates reach the end of the training phase.

    The progress ``env_steps`` may be ahead of them, in a trial that runs or has failed.
    """
    reached = sweep.updates.groupby(list(KEY), observed=True)["end_step"].max().rename("_reached")
    trials = sweep.trials.join(reached, on=list(KEY))
    return sweep.trials[(trials["_reached"] >= trials["boundary_step"]).to_numpy()]


def training_totals(sweep: Sweep) -> pd.DataFrame:
    """Return the cost of relaxed training: a row per trial whose training phase is over and has an episode.

    Returns:
        KEY, episodes, steps; cost_i_total (the paper's SUM-J_C,i: all cost of training, within the limit or
        not); excess_i_total (its part above d_d, episode by episode); updates_with_cost_i (policy updates in
        which an episode ended, so that there is a mean cost); updates_over_i (such updates with a mean cost
        above the limit in force).
    """
    trained = with_finished_training(sweep)
    phases = sweep.phases[sweep.phases["phase"] == Phase.TRAINING.value]
    totals = [f"{kind}_{i}_total" for i in range(sweep.num_costs) for kind in ("cost", "excess")]
    rows = phases[[*KEY, "episodes", "steps", *totals]].merge(trained[list(KEY)], on=list(KEY))
    updates = sweep.updates[sweep.updates["phase"] == Phase.TRAINING.value]
    for i in range(sweep.num_costs):
        cost = updates[f"cost_{i}"]
        counted = updates[list(KEY)].assign(
            **{f"updates_with_cost_{i}": cost.notna(), f"updates_over_{i}": cost > updates[f"limit_{i}"]}
        )
        rows = rows.merge(counted.groupby(list(KEY), observed=True).sum().reset_index(), on=list(KEY))
    return rows


def summary(rows: pd.DataFrame, trials: pd.DataFrame) -> pd.DataFrame:
    """Average outcomes over seeds: one row per task, agent, method and measure.

    A failed trial has no return and no cost, so the means are over the complete trials, feasible or not. In
    the fractions it counts as neither feasible nor solved. Otherwise an agent that diverges on bad seeds
    would have the higher success rate.

    Args:
        rows: of ``outcomes``.
        trials: of the sweep, complete or not.

    Returns:
        GROUP, measure, seeds (complete trials), failed (failed trials), then mean and standard error
        (``_se``) of episode_return, cost_i and gap, deploy_limit_i, optimal_return, exact (whether every seed
        is; false without one); feasible_seeds and their share of the complete and failed trials,
        feasible_share, with Wilson's 95% interval (feasible_low, feasible_high); optimal_seeds with Wilson's
        interval of their share (optimal_low, optimal_high).
        Groups without a complete or failed trial are left out.
    """
    names = [str(name) for name in rows]
    averaged = [name for name in names if name in ("episode_return", "gap") or is_cost(name)]
    constant = [name for name in names if name.startswith("deploy_limit_") or name == "optimal_return"]
    found = dict(iter(rows.groupby([*GROUP, "measure"], observed=True, sort=False)))
    measured = rows.groupby("task", observed=True)["measure"].agg(set).to_dict()
    lines = []
    for group, planned in trials.groupby(list(GROUP), observed=True, sort=False):
        failed = int((planned["status"] == TrialStatus.FAILED.value).sum())
        of_task = measured.get(group[0], {Measure.STOCHASTIC.value})  # none: every trial of the task failed
        for measure in (it.value for it in Measure if it.value in of_task):
            chosen = found.get((*group, measure), rows.iloc[:0])
            if not len(chosen) + failed:
                continue
            line: dict[str, Any] = dict(zip((*GROUP, "measure"), (*group, measure), strict=True))
            line |= {"seeds": len(chosen), "failed": failed}
            for name in averaged:
                line[name], line[f"{name}_se"] = mean_and_standard_error(chosen[name].to_numpy(np.float64))
            line |= {name: planned[name].iloc[0] for name in constant}
            line["exact"] = bool(len(chosen) and chosen["exact"].all())
            lines.append(line | _shares(chosen, len(chosen) + failed))
    return pd.DataFrame(lines)


def _shares(chosen: pd.DataFrame, ended: int) -> dict[str, float]:
    """Return the numbers of feasible and solved trials, with Wilson's intervals of their shares.

    Args:
        chosen: outcomes of the complete trials.
        ended: number of complete and failed trials.
    """
    share, best = (wilson_interval(int(chosen[name].sum()), ended) for name in ("feasible", "optimal"))
    return {
        "feasible_seeds": int(chosen["feasible"].sum()),
        "feasible_share": share.estimate,
        "feasible_low": share.low,
        "feasible_high": share.high,
        "optimal_seeds": int(chosen["optimal"].sum()),
        "optimal_low": best.low,
        "optimal_high": best.high,
    }


def robust_summary(rows: pd.DataFrame, generator: np.random.Generator) -> pd.DataFrame:
    """Return interquartile means of the return with 95% bootstrap intervals: one row per GROUP and measure.

    They are over all complete trials, feasible or not: an infeasible policy may return more than is allowed.

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


def _deployment(sweep: Sweep, costs: list[str]) -> pd.DataFrame:
    chosen = sweep.phases[sweep.phases["phase"] == Phase.DEPLOYMENT.value]
    rows = chosen[[*KEY, "episodes"]].assign(measure=Measure.DEPLOYMENT.value, exact=False)
    for name in ("episode_return", *costs):
        rows[name] = chosen[name]
        rows[f"{name}_se"] = chosen[f"{name}_std"] / np.sqrt(chosen["episodes"].astype(np.float64))
    return rows


def _frozen(sweep: Sweep, costs: list[str]) -> pd.DataFrame:
    values = sweep.evaluations.rename(columns={"policy": "measure"})
    grouped = values.groupby([*KEY, "measure"], observed=True)
    rows = grouped.size().rename("episodes").reset_index().assign(exact=False)
    for name in ("episode_return", *costs):
        statistics = grouped[name].agg(["mean", "sem"]).reset_index()
        rows[name], rows[f"{name}_se"] = statistics["mean"], statistics["sem"]
    return rows


def _with_exact(sampled: pd.DataFrame, exact: pd.DataFrame) -> pd.DataFrame:
    """Replace sampled means by exact values if known, and add those of policies that were not sampled.

    The standard errors of exact values are 0; policies that were not sampled have 0 episodes.
    """
    if not len(exact):
        return sampled
    key = [*KEY, "measure"]
    exact = exact.rename(columns={"policy": "measure"})
    if not len(sampled):  # the column may have any type then
        sampled = sampled.astype({"measure": exact["measure"].dtype})
    exact = exact.astype({name: sampled[name].dtype for name in key})
    sampled = sampled.merge(exact[key], on=key, how="outer")
    sampled["episodes"] = sampled["episodes"].fillna(0).astype(np.int64)
    rows = sampled[key].merge(exact, on=key, how="left")
    known = rows["episode_return"].notna().to_numpy()
    sampled = sampled.assign(exact=known)
    for name in (str(column) for column in rows if column not in key):
        values = rows[name].to_numpy(np.float64)
        sampled[name] = np.where(known, values, sampled[name])
        sampled[f"{name}_se"] = np.where(
            known, np.where(np.isnan(values), np.nan, 0.0), sampled[f"{name}_se"]
        )
    return sampled
