"""Counts of verdicts on the final policies (solved, feasible, infeasible), by task, agent and curriculum.

Every verdict is on the stochastic final policy, evaluated without learning.
``recrl.analysis.statistics.verdicts`` defines the verdicts. The deployment phase is given for comparison
only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from recrl.analysis.data.labels import GROUP, KEY
from recrl.analysis.statistics.metrics import Measure
from recrl.analysis.statistics.verdicts import is_cost

FINAL = Measure.STOCHASTIC


def count_verdicts(
    rows: pd.DataFrame,
    compared: pd.DataFrame,
    flags: pd.DataFrame,
    names: Mapping[str, Sequence[str]] | None = None,
) -> pd.DataFrame:
    """Count the verdicts: one row per GROUP.

    Args:
        rows: of ``metrics.outcomes``.
        compared: of ``metrics.comparisons``, with the baseline ``none``.
        flags: of ``sweep_warnings.curriculum_flags``.
        names: of ``cost_names``: the names of the costs of each task with several; their numbers by default.

    Returns:
        GROUP, seeds, solved, feasible (the solved ones included), infeasible; worst_excess (the largest cost
        above its limit among the infeasible seeds, or NaN); worst_share (the same divided by that limit); for
        several costs worst_cost (the name of that cost, or empty) and cost_name_i;
        episode_return and cost_i (means over seeds, with standard errors _se; NaN for one seed);
        deploy_limit_i, optimal_return, exact (whether every seed is), episodes (of a seed);
        deployment_return and deployment_cost_i (likewise, with _se); no_curriculum and hard_landing (seeds
        that have the flag); return_difference with _low and _high (NaN without a baseline).
    """
    final = rows[rows["measure"] == FINAL.value]
    deployed = rows[rows["measure"] == Measure.DEPLOYMENT.value]
    costs = [str(name) for name in rows if is_cost(str(name))]
    lines = []
    for group, seeds in final.groupby(list(GROUP), observed=True, sort=False):
        line = dict(zip(GROUP, group, strict=True)) | _counts(seeds)
        task = str(seeds["task"].iloc[0])
        named = dict(zip(costs, (names or {}).get(task, ()), strict=False)) or {
            name: name.removeprefix("cost_") for name in costs
        }
        line |= _worst(seeds, costs, named)
        for name in ("episode_return", *costs):
            line |= {name: seeds[name].mean(), f"{name}_se": seeds[name].sem()}
        constant = ["optimal_return", *(f"deploy_{name.replace('cost', 'limit')}" for name in costs)]
        line |= {name: seeds[name].iloc[0] for name in constant}
        line |= {"exact": bool(seeds["exact"].all()), "episodes": int(seeds["episodes"].min())}
        lines.append(line)
    table = pd.DataFrame(lines, columns=None if lines else [*GROUP])
    renamed = {"episode_return": "deployment_return"} | {name: f"deployment_{name}" for name in costs}
    beside = deployed.rename(columns=renamed).groupby(list(GROUP), observed=True)[list(renamed.values())]
    for statistics in (beside.mean(), beside.sem().add_suffix("_se")):
        table = table.merge(statistics.reset_index(), on=list(GROUP), how="left")
    flagged = final[list(KEY)].merge(flags, on=list(KEY))
    counts = flagged.groupby(list(GROUP), observed=True)[["no_curriculum", "hard_landing"]].sum()
    table = table.merge(counts.reset_index(), on=list(GROUP), how="left")
    return table.merge(_differences(compared), on=list(GROUP), how="left")


def _counts(seeds: pd.DataFrame) -> dict[str, int]:
    counts = {"solved": seeds["optimal"].sum(), "feasible": seeds["feasible"].sum()}
    infeasible = len(seeds) - counts["feasible"]
    return {"seeds": len(seeds)} | {k: int(v) for k, v in (counts | {"infeasible": infeasible}).items()}


def _worst(seeds: pd.DataFrame, costs: list[str], named: Mapping[str, str]) -> dict[str, float | str]:
    """Return the largest excess among the infeasible seeds, its fraction of the limit, and its cost."""
    broken = seeds[~seeds["feasible"]]
    limits = {name: seeds[f"deploy_{name.replace('cost', 'limit')}"].iloc[0] for name in costs}
    excess = [
        (float((broken[name] - limits[name]).max()), float(limits[name]), named.get(name, ""))
        for name in costs
    ]
    worst, limit, cost = max((it for it in excess if it[0] > 0.0), default=(math.nan, math.nan, ""))
    found: dict[str, float | str] = {
        "worst_excess": worst,
        "worst_share": worst / limit if limit > 0.0 else math.nan,
    }
    if len(costs) == 1:
        return found
    return (
        found
        | {"worst_cost": cost}
        | {name.replace("cost", "cost_name"): named.get(name, "") for name in costs}
    )


def _differences(compared: pd.DataFrame) -> pd.DataFrame:
    ends = ["return_difference", "return_difference_low", "return_difference_high"]
    if not len(compared):
        return pd.DataFrame(columns=[*GROUP, *ends])
    return compared.loc[compared["measure"] == FINAL.value, [*GROUP, *ends]]
