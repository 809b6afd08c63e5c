"""Counts of verdicts on the final policies (solved, feasible, infeasible), by task, agent and curriculum.

Every verdict is on the stochastic final policy, evaluated without learning.
``recrl.analysis.statistics.verdicts`` defines the verdicts. The deployment phase is given for comparison
only. Trials without such a policy are counted beside the verdicts. A failed trial is neither solved nor
feasible; a pending one may still become either.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from recrl.analysis.data.labels import GROUP, KEY
from recrl.analysis.statistics.metrics import Measure
from recrl.analysis.statistics.verdicts import is_cost, worst_costs
from recrl.orchestrator.files.outcomes_file import VERDICT_MEASURE
from recrl.orchestrator.spec import TrialStatus

FINAL = Measure(VERDICT_MEASURE)


def count_verdicts(
    rows: pd.DataFrame,
    compared: pd.DataFrame,
    flags: pd.DataFrame,
    trials: pd.DataFrame,
    names: Mapping[str, Sequence[str]] | None = None,
) -> pd.DataFrame:
    """Count the verdicts: one row per GROUP of the sweep; no row before a final policy was evaluated.

    Args:
        rows: of ``metrics.outcomes``.
        compared: of ``comparisons.comparisons``, with the baseline ``none``.
        flags: of ``sweep_warnings.curriculum_flags``.
        trials: of the sweep, complete or not.
        names: of ``cost_names``: the names of the costs of each task with several; their numbers by default.

    Returns:
        GROUP, seeds (evaluated final policies), solved, feasible (the solved ones included), infeasible;
        planned (all trials), failed, pending (neither complete nor failed: they wait, run or are damaged);
        worst_excess (the largest cost above its limit among the infeasible seeds, or NaN; of several costs
        the one furthest above its limit, as a fraction of the limit); worst_share (the same divided by that
        limit); for several costs worst_cost (the name of that cost, or empty) and cost_name_i (empty if the
        task has no cost i);
        episode_return and cost_i (means over seeds, with standard errors _se; NaN for one seed);
        deploy_limit_i, optimal_return, exact (whether every seed is; false without a seed), episodes (of a
        seed); deployment_return and deployment_cost_i (likewise, with _se); no_curriculum and hard_landing
        (seeds that have the flag); pairs, feasible_pairs and return_difference with _low and _high, as in
        ``comparisons.comparisons`` (NaN without a baseline).
    """
    final = rows[rows["measure"] == FINAL.value]
    deployed = rows[rows["measure"] == Measure.DEPLOYMENT.value]
    costs = [str(name) for name in rows if is_cost(str(name))]
    if not len(final):
        return pd.DataFrame(columns=list(GROUP))
    evaluated = dict(iter(final.groupby(list(GROUP), observed=True)))
    lines = []
    for group, planned in trials.groupby(list(GROUP), observed=True, sort=False):
        seeds = evaluated.get(group, final.iloc[:0])
        line = dict(zip(GROUP, group, strict=True)) | _counts(seeds) | _states(planned["status"])
        task = str(group[0])
        limits = {name: float(planned[f"deploy_{name.replace('cost', 'limit')}"].iloc[0]) for name in costs}
        named = dict(zip(costs, (names or {}).get(task, ()), strict=False)) or {
            name: name.removeprefix("cost_") for name, limit in limits.items() if not math.isnan(limit)
        }
        line |= _worst(seeds, limits, named)
        for name in ("episode_return", *costs):
            line |= {name: seeds[name].mean(), f"{name}_se": seeds[name].sem()}
        line["optimal_return"] = planned["optimal_return"].iloc[0]
        line |= {f"deploy_{name.replace('cost', 'limit')}": limit for name, limit in limits.items()}
        line["exact"] = bool(len(seeds) and seeds["exact"].all())
        line["episodes"] = int(seeds["episodes"].min()) if len(seeds) else 0
        lines.append(line)
    table = pd.DataFrame(lines)
    renamed = {"episode_return": "deployment_return"} | {name: f"deployment_{name}" for name in costs}
    beside = deployed.rename(columns=renamed).groupby(list(GROUP), observed=True)[list(renamed.values())]
    for statistics in (beside.mean(), beside.sem().add_suffix("_se")):
        table = table.merge(statistics.reset_index(), on=list(GROUP), how="left")
    flagged = final[list(KEY)].merge(flags, on=list(KEY))
    warned = ["no_curriculum", "hard_landing"]
    counts = flagged.groupby(list(GROUP), observed=True)[warned].sum()
    table = table.merge(counts.reset_index(), on=list(GROUP), how="left")
    table[warned] = table[warned].fillna(0).astype(int)
    table = table.merge(_differences(compared), on=list(GROUP), how="left")
    return table.astype({"pairs": "Int64", "feasible_pairs": "Int64"})


def _counts(seeds: pd.DataFrame) -> dict[str, int]:
    counts = {"solved": seeds["optimal"].sum(), "feasible": seeds["feasible"].sum()}
    infeasible = len(seeds) - counts["feasible"]
    return {"seeds": len(seeds)} | {k: int(v) for k, v in (counts | {"infeasible": infeasible}).items()}


def _states(status: pd.Series[str]) -> dict[str, int]:
    """Count the trials of a group: all of them, the failed ones, and those that have not ended."""
    complete, failed = (
        int((status == state.value).sum()) for state in (TrialStatus.COMPLETE, TrialStatus.FAILED)
    )
    return {"planned": len(status), "failed": failed, "pending": len(status) - complete - failed}


def _worst(
    seeds: pd.DataFrame, limits: Mapping[str, float], named: Mapping[str, str]
) -> dict[str, float | str]:
    """Return the largest excess among the infeasible seeds, its fraction of the limit, and its cost.

    It is chosen as in ``verdicts.worst_costs``.
    """
    found: dict[str, float | str] = {"worst_excess": math.nan, "worst_share": math.nan}
    cost = ""
    exceeded = worst_costs(seeds).dropna().sort_values(["worst_share", "worst_excess"], kind="stable")
    if len(exceeded):
        worst = exceeded.iloc[-1]
        cost = named.get(f"cost_{worst['worst_cost']}", "")
        share = worst["worst_share"] if math.isfinite(worst["worst_share"]) else math.nan
        found = {"worst_excess": worst["worst_excess"], "worst_share": share}
    if len(limits) == 1:
        return found
    return (
        found
        | {"worst_cost": cost}
        | {name.replace("cost", "cost_name"): named.get(name, "") for name in limits}
    )


def _differences(compared: pd.DataFrame) -> pd.DataFrame:
    columns = ["pairs", "feasible_pairs"]
    columns += ["return_difference", "return_difference_low", "return_difference_high"]
    if not len(compared):
        return pd.DataFrame(columns=[*GROUP, *columns])
    return compared.loc[compared["measure"] == FINAL.value, [*GROUP, *columns]]
