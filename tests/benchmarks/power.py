"""How large a difference between two curricula a number of seeds can show.

    python tests/benchmarks/power.py results/safety-gym/agents.csv results/safety-gym/curricula.csv

The spread over seeds is the standard deviation s of the returns of final policies that differ in the seed
only, pooled over the groups (table, agent, curriculum) of a task. For n pairs of seeds the table has the
smallest true difference that a paired t test at 5% finds with a probability of 80%. If the two trials of a
seed are independent, their difference has the standard deviation s sqrt(2). The power is exact, from the
noncentral t distribution.
"""

from __future__ import annotations

import argparse
import math

import pandas as pd
from scipy import optimize, stats

LEVEL, POWER = 0.05, 0.8
PAIRS = (3, 5, 10, 20)


def power(difference: float, pairs: int) -> float:
    """Return the power of a two-sided paired t test; the difference is in its standard deviations."""
    critical = stats.t.ppf(1.0 - LEVEL / 2.0, pairs - 1)
    shift = difference * math.sqrt(pairs)
    return float(1.0 - stats.nct.cdf(critical, pairs - 1, shift) + stats.nct.cdf(-critical, pairs - 1, shift))


def detectable(pairs: int) -> float:
    """Return the difference, in standard deviations, that is found with probability POWER."""
    return float(
        optimize.brentq(lambda difference: power(difference, pairs) - POWER, 0.0, 8.0 / math.sqrt(pairs))
    )


def pooled(returns: pd.DataFrame) -> tuple[float, int]:
    """Return the standard deviation over seeds, pooled over groups, and its degrees of freedom."""
    groups = returns.groupby(["table", "agent", "method"])["return"]
    squares = groups.apply(lambda group: ((group - group.mean()) ** 2).sum())
    degrees = int((groups.size() - 1).sum())
    return (math.sqrt(squares.sum() / degrees) if degrees else math.nan), degrees


def main() -> None:
    parser = argparse.ArgumentParser(description="How large a difference some seeds can show.")
    parser.add_argument("tables", nargs="+", help="CSV files of final policies")
    given = parser.parse_args()
    read = pd.concat([pd.read_csv(path).assign(table=path) for path in given.tables], ignore_index=True)
    rows = read[read["policy"] == "stochastic"].drop_duplicates(["task", "agent", "method", "seed", "return"])
    print("differences in standard deviations of the difference:")
    print("  ", ", ".join(f"{detectable(pairs):.2f} with {pairs} pairs" for pairs in PAIRS))
    print(f"{'task':14}{'s':>7}{'(degrees)':>11}" + "".join(f"{pairs:>4} pairs" for pairs in PAIRS))
    for task, returns in rows.groupby("task"):
        spread, degrees = pooled(returns)
        shown = "".join(f"{math.sqrt(2.0) * spread * detectable(pairs):>10.1f}" for pairs in PAIRS)
        print(f"{task:14}{spread:7.2f}{degrees:11}" + shown)


if __name__ == "__main__":
    main()
