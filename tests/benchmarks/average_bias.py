"""How much averages of policies cost above the policies that they average, from tables of ``fresh_costs.py``.

    cd results/velocity
    python ../../tests/benchmarks/average_bias.py average-decay-last-statistics.csv average-decay.csv

The policies that an average of decay a contains cost, while they learnt, the mean of their ``training_cost``
with weights a^k, k updates ago. Differences are means over the evaluated updates, +- 1 standard error. The
last line of each table is their mean over the trials, with Student's 95% interval. With two tables the second
is also subtracted from the first, update by update.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

KEYS = ["task", "agent", "seed"]


def averaged_costs(costs: pd.Series[float], decay: float) -> pd.Series[float]:
    """Return the weighted mean cost of the policies that the average at each update contains."""
    return costs.iloc[1:].ewm(alpha=1.0 - decay).mean()  # it begins with the policy after the first update


def show(differences: dict[str, pd.Series[float]]) -> None:
    """Print each trial's mean difference, and the mean of all."""
    means = np.array([values.mean() for values in differences.values()])
    for name, values in differences.items():
        print(f"  {name}: {values.mean():.1f} +- {stats.sem(values):.1f} ({len(values)} updates)")
    low, high = stats.t.interval(0.95, len(means) - 1, means.mean(), stats.sem(means))
    print(f"  mean: {means.mean():.1f} ({low:.1f} to {high:.1f})")


def main() -> None:
    """Read and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tables", type=Path, nargs="+")
    parser.add_argument("--decays", type=float, nargs="*", default=[0.8, 0.9])
    arguments = parser.parse_args()
    tables = [pd.read_csv(path) for path in arguments.tables]
    for decay in arguments.decays:
        column, found = f"average_{decay}_cost", []
        for path, table in zip(arguments.tables, tables, strict=True):
            groups = {" ".join(map(str, key)): trial for key, trial in table.groupby(KEYS)}
            found.append({name: trial.set_index("update")[column].dropna() for name, trial in groups.items()})
            print(f"{path.name}, decay {decay}: above the policies that it averages")
            trained = {
                name: averaged_costs(trial.set_index("update")["training_cost"], decay)
                for name, trial in groups.items()
            }
            show({name: (costs - trained[name]).dropna() for name, costs in found[-1].items()})
            print(f"{path.name}, decay {decay}: above the last policies")
            last = {name: trial.set_index("update")["fresh_cost"] for name, trial in groups.items()}
            show({name: (costs - last[name]).dropna() for name, costs in found[-1].items()})
        if len(found) == 2:
            print(f"decay {decay}: the first table less the second")
            show({name: costs - found[1][name] for name, costs in found[0].items()})


if __name__ == "__main__":
    main()
