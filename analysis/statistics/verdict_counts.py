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
from recrl.analysis.statistics.verdicts import exceeded_costs, is_cost, within_limits
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
        feasible_by_error (feasible policies with a cost that only its standard error allows);
        planned (all trials), failed, pending (neither complete nor failed: they wait, run or are damaged);
        exceeded_i (evaluated final policies that exceed limit i), excess_i_low and excess_i_high (least and
        largest excess among them, NaN if there are none); cost_name_i, only if a task has several costs
        (empty if the task has one cost, or no cost i);
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
        line |= _excesses(seeds)
        line |= _cost_names(limits, (names or {}).get(task, ()))
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
    feasible, without_errors = seeds["feasible"], seeds.filter(regex=r"^(?!cost_\d+_se$)")
    counts = {
        "solved": seeds["optimal"].sum(),
        "feasible": feasible.sum(),
        "infeasible": len(seeds) - feasible.sum(),
        "feasible_by_error": (feasible & ~within_limits(without_errors)).sum(),
    }
    return {"seeds": len(seeds)} | {name: int(count) for name, count in counts.items()}


def _states(status: pd.Series[str]) -> dict[str, int]:
    """Count the trials of a group: all of them, the failed ones, and those that have not ended."""
    complete, failed = (
        int((status == state.value).sum()) for state in (TrialStatus.COMPLETE, TrialStatus.FAILED)
    )
    return {"planned": len(status), "failed": failed, "pending": len(status) - complete - failed}


def _excesses(seeds: pd.DataFrame) -> dict[str, float]:
    """Return for each cost how many policies exceed its limit, and the least and the largest excess."""
    found: dict[str, float] = {}
    for name, excess in exceeded_costs(seeds).items():
        i = str(name).removeprefix("excess_")
        found |= {f"exceeded_{i}": int(excess.notna().sum())}
        found |= {f"excess_{i}_low": excess.min(), f"excess_{i}_high": excess.max()}
    return found


def _cost_names(limits: Mapping[str, float], names: Sequence[str]) -> dict[str, str]:
    """Return the columns cost_name_i of a task; none if the sweep has one cost only.

    Args:
        limits: of each cost of the sweep, NaN if the task lacks it.
        names: of the task's costs; empty if they are not known.
    """
    if len(limits) == 1:
        return {}
    present = [name for name, limit in limits.items() if not math.isnan(limit)]
    numbers = [name.removeprefix("cost_") for name in present]
    named = dict(zip(present, names or numbers, strict=False)) if len(present) > 1 else {}
    return {name.replace("cost", "cost_name"): named.get(name, "") for name in limits}


def _differences(compared: pd.DataFrame) -> pd.DataFrame:
    columns = ["pairs", "feasible_pairs"]
    columns += ["return_difference", "return_difference_low", "return_difference_high"]
    if not len(compared):
        return pd.DataFrame(columns=[*GROUP, *columns])
    return compared.loc[compared["measure"] == FINAL.value, [*GROUP, *columns]]
