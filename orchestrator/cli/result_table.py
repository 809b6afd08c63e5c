"""The table that a launch ends with: what the final policies earn and cost, by task, agent and method."""

from __future__ import annotations

import math
from collections.abc import Hashable

import numpy as np
import pandas as pd

from recrl.analysis.data.labels import GROUP
from recrl.analysis.data.sweep_data import Sweep
from recrl.analysis.report_tables import number, with_error
from recrl.analysis.statistics.metrics import Measure, outcomes

CAPTION = (
    "Final policies (stochastic), evaluated without learning: means over n seeds, with standard errors.\n"
    "Feasible: seeds whose mean cost keeps the deployment limit."
)


def result_table(sweep: Sweep) -> pd.DataFrame:
    """The results as text, a row a task, agent and method; empty where no complete trial was evaluated.

    Args:
        sweep: its complete trials count.
    """
    if sweep.evaluations.empty:
        return pd.DataFrame()
    rows = outcomes(sweep)
    rows = rows[rows["measure"] == Measure.STOCHASTIC.value]
    groups = rows.groupby(list(GROUP), observed=True, sort=False)
    return pd.DataFrame([_line(group, seeds, sweep.num_costs) for group, seeds in groups])


def _line(group: tuple[Hashable, ...], seeds: pd.DataFrame, num_costs: int) -> dict[str, str]:
    line = dict(zip(GROUP, map(str, group), strict=True)) | {"n": str(len(seeds))}
    line["return"] = _mean_text(seeds["episode_return"])
    for i in range(num_costs):
        which = "" if num_costs == 1 else f" {i + 1}"
        line[f"cost{which}"] = _mean_text(seeds[f"cost_{i}"])
        line[f"limit{which}"] = number(float(seeds[f"deploy_limit_{i}"].iloc[0]))
    line["feasible"] = f"{int(seeds['feasible'].sum())} of {len(seeds)}"
    return line


def _mean_text(values: pd.Series[float]) -> str:
    numbers = values.to_numpy(np.float64)
    error = numbers.std(ddof=1) / math.sqrt(len(numbers)) if len(numbers) > 1 else math.nan
    return with_error(float(numbers.mean()), float(error))
