"""What agents earn and cost above a control: intervals and corrected tests.

    cd results/safety-gym
    python ../../tests/benchmarks/differences.py margin.csv --control agents.csv
    python ../../tests/benchmarks/differences.py curricula-today.csv --against none

Tables are those of ``final_policies.py``. With ``--control`` each group is the seeds of one agent on one
task, and the groups are independent (Student's intervals); a task without a control is left out. With one
agent and several tasks the last line averages their differences (Welch's interval). With ``--against`` the
control is that curriculum in the same tables, and trials are paired by seed, or with ``--groups`` independent
(Welch). With ``--limit`` only policies count whose mean cost is at most one standard error, over episodes,
above it. The p values are corrected for all rows of a table, by Holm's method.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from recrl.analysis.statistics.intervals import CONFIDENCE, group_difference, holm, paired_difference
from recrl.environments.cmdp import Floats


def read(paths: Sequence[Path], policy: str, limit: float) -> pd.DataFrame:
    """The rows of one kind of policy that keep a limit."""
    rows = pd.concat([pd.read_csv(path, comment="#") for path in paths], ignore_index=True)
    if rows.duplicated(["task", "agent", "method", "seed", "policy"]).any():
        raise SystemExit("a trial is in the tables twice")
    kept = rows["cost"] <= limit + rows["cost_se"] if math.isfinite(limit) else True
    return rows[(rows["policy"] == policy) & kept]


def difference(values: Floats, control: Floats) -> tuple[float, float, float, float]:
    """The difference of two means, the ends of its interval, and the p value of a t test."""
    test = stats.ttest_ind(values, control)
    low, high = test.confidence_interval(CONFIDENCE)
    return float(values.mean() - control.mean()), float(low), float(high), float(test.pvalue)


def differences(rows: pd.DataFrame, control: pd.DataFrame, column: str) -> pd.DataFrame:
    """A row a task and agent, with the numbers of seeds on both sides."""
    found = []
    for (task, agent), group in rows.groupby(["task", "agent"]):
        base = control.loc[control["task"] == task, column].to_numpy()
        found.append((task, agent, len(group), len(base), *difference(group[column].to_numpy(), base)))
    table = pd.DataFrame(found, columns=["task", "agent", "n", "n_control", column, "low", "high", "p"])
    return table.assign(p_holm=holm(table["p"].to_numpy()))


def differences_from(
    rows: pd.DataFrame, baseline: str, column: str, *, as_groups: bool = False
) -> pd.DataFrame:
    """A row a task, agent and curriculum: it minus the baseline, over the two or more seeds with both.

    With ``as_groups`` the test is Welch's of two independent groups, otherwise Student's of pairs of seeds.
    """
    wide = rows.pivot(index=["task", "agent", "seed"], columns="method", values=column)
    compare = group_difference if as_groups else paired_difference
    found = []
    for method in wide.columns.drop(baseline):
        pairs = wide[[method, baseline]].dropna()
        for (task, agent), pair in pairs.groupby(level=["task", "agent"]):
            if len(pair) > 1:
                it = compare(pair[method].to_numpy(), pair[baseline].to_numpy())
                found.append((task, agent, method, len(pair), it.estimate, it.low, it.high, it.p_value))
    table = pd.DataFrame(found, columns=["task", "agent", "method", "n", column, "low", "high", "p"])
    table = table.sort_values(["task", "agent", "method"])
    return table.assign(p_holm=holm(table["p"].to_numpy()))


def average(rows: pd.DataFrame, control: pd.DataFrame, column: str) -> str:
    """The mean of the tasks' differences; the tasks are fixed, the seeds random."""
    pairs = [
        (group[column].to_numpy(), control.loc[control["task"] == task, column].to_numpy())
        for task, group in rows.groupby("task")
    ]
    return weighted_sum(
        [each for pair in pairs for each in pair], [1.0 / len(pairs), -1.0 / len(pairs)] * len(pairs)
    )


def weighted_sum(groups: Sequence[Floats], weights: Sequence[float]) -> str:
    """The weighted sum of the means of independent groups, with Welch's interval.

    The degrees of freedom are Satterthwaite's.

    >>> weighted_sum([np.array([1.0, 2.0, 3.0]), np.array([4.0, 6.0])], [1.0, -1.0])
    '-3.00 (-8.98 to 2.98; 1.7 degrees of freedom)'
    """
    errors = [weight**2 * each.var(ddof=1) / len(each) for each, weight in zip(groups, weights, strict=True)]
    parts = np.array(errors)
    degrees = parts.sum() ** 2 / (parts**2 / np.array([len(each) - 1 for each in groups])).sum()
    total = float(sum(weight * each.mean() for each, weight in zip(groups, weights, strict=True)))
    reach = math.sqrt(parts.sum()) * float(stats.t.ppf(0.5 + 0.5 * CONFIDENCE, degrees))
    return f"{total:.2f} ({total - reach:.2f} to {total + reach:.2f}; {degrees:.1f} degrees of freedom)"


def main() -> None:
    """Print the differences in return and in cost."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tables", type=Path, nargs="+")
    control_options = parser.add_mutually_exclusive_group(required=True)
    control_options.add_argument("--control", type=Path, nargs="+")
    control_options.add_argument("--against", metavar="CURRICULUM")
    parser.add_argument("--groups", action="store_true", help="with --against: two groups (Welch), not pairs")
    parser.add_argument("--policy", default="stochastic")
    parser.add_argument("--limit", type=float, default=math.inf, help="of the cost; default: none")
    arguments = parser.parse_args()
    rows = read(arguments.tables, arguments.policy, arguments.limit)
    if arguments.against is not None:
        for column in ("return", "cost"):
            how = "difference of two groups" if arguments.groups else "paired difference"
            table = differences_from(rows, arguments.against, column, as_groups=arguments.groups)
            print(f"{column}: {how}, 95% interval, p, p corrected for all rows")
            print(table.round(3).to_string(index=False))
        return
    control = read(arguments.control, arguments.policy, arguments.limit)
    rows = rows[rows["task"].isin(control["task"])]
    for table in (rows, control):
        if (table.groupby(["task", "agent"])["method"].nunique() > 1).any():
            raise SystemExit("--control: a table has several curricula of one agent; use --against")
    agents = rows.groupby("task")["agent"].nunique()
    for column in ("return", "cost"):
        print(f"{column}: difference, 95% interval, p, p corrected for all rows")
        print(differences(rows, control, column).round(3).to_string(index=False))
        if len(agents) > 1 and (agents == 1).all():
            print("mean over the tasks:", average(rows, control, column))


if __name__ == "__main__":
    main()
