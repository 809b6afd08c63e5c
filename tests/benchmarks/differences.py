"""What agents earn and cost above a control: Student's intervals for two independent groups, corrected tests.

    cd results/safety-gym
    python ../../tests/benchmarks/differences.py margin.csv --control agents.csv

Tables are those of ``final_policies.py``. Each group is the seeds of one agent on one task; a task without a
control is left out. The p values are corrected for all rows that are printed, by Holm's method. With one
agent a task the last line averages the tasks' differences, with the variance within groups pooled.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from recrl.environments.cmdp import Floats

CONFIDENCE = 0.95


def read(paths: Sequence[Path], policy: str) -> pd.DataFrame:
    """The rows of one kind of policy."""
    rows = pd.concat([pd.read_csv(path, comment="#") for path in paths], ignore_index=True)
    return rows[rows["policy"] == policy]


def difference(values: Floats, control: Floats) -> tuple[float, float, float, float]:
    """The difference of two means, the ends of its interval, and the p value of a t test."""
    test = stats.ttest_ind(values, control)
    low, high = test.confidence_interval(CONFIDENCE)
    return float(values.mean() - control.mean()), float(low), float(high), float(test.pvalue)


def holm(p_values: Floats) -> Floats:
    """P values corrected for their number (Holm 1979).

    >>> holm(np.array([0.03, 0.01, 0.04])).round(2).tolist()
    [0.06, 0.03, 0.06]
    """
    order = np.argsort(p_values)
    factors = np.arange(len(p_values), 0, -1)
    corrected = np.empty_like(p_values)
    corrected[order] = np.minimum(np.maximum.accumulate(p_values[order] * factors), 1.0)
    return corrected


def differences(rows: pd.DataFrame, control: pd.DataFrame, column: str) -> pd.DataFrame:
    """A row a task and agent, with the numbers of seeds on both sides."""
    found = []
    for (task, agent), group in rows.groupby(["task", "agent"]):
        base = control.loc[control["task"] == task, column].to_numpy()
        found.append((task, agent, len(group), len(base), *difference(group[column].to_numpy(), base)))
    table = pd.DataFrame(found, columns=["task", "agent", "n", "n_control", column, "low", "high", "p"])
    return table.assign(p_holm=holm(table["p"].to_numpy()))


def average(rows: pd.DataFrame, control: pd.DataFrame, column: str) -> str:
    """The mean of the tasks' differences; the tasks are fixed, the seeds random."""
    pairs = [
        (group[column].to_numpy(), control.loc[control["task"] == task, column].to_numpy())
        for task, group in rows.groupby("task")
    ]
    degrees = sum(len(each) - 1 for pair in pairs for each in pair)
    variance = sum(((each - each.mean()) ** 2).sum() for pair in pairs for each in pair) / degrees
    mean = float(np.mean([values.mean() - base.mean() for values, base in pairs]))
    error = math.sqrt(variance * sum(1.0 / len(each) for pair in pairs for each in pair)) / len(pairs)
    reach = error * float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, degrees))
    return f"{mean:.2f} ({mean - reach:.2f} to {mean + reach:.2f}; {degrees} degrees of freedom)"


def main() -> None:
    """Print the differences in return and in cost."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tables", type=Path, nargs="+")
    parser.add_argument("--control", type=Path, nargs="+", required=True)
    parser.add_argument("--policy", default="stochastic")
    arguments = parser.parse_args()
    rows, control = read(arguments.tables, arguments.policy), read(arguments.control, arguments.policy)
    rows = rows[rows["task"].isin(control["task"])]
    one_agent = bool((rows.groupby("task")["agent"].nunique() == 1).all())
    for column in ("return", "cost"):
        print(f"{column}: difference, 95% interval, p, p corrected for all rows")
        print(differences(rows, control, column).round(3).to_string(index=False))
        if one_agent:
            print("mean over the tasks:", average(rows, control, column))


if __name__ == "__main__":
    main()
