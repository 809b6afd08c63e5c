"""How large a difference between two curricula a number of seeds can show.

    python tests/benchmarks/power.py results/safety-gym/agents.csv results/safety-gym/curricula-today.csv

The spread is the standard deviation s of the returns of final policies of one agent and curriculum on a task,
over seeds and repetitions, pooled over agents and curricula. For n seeds of each of two curricula the table
has the smallest true difference that a t test at 5% finds with a probability of 80%. With ``--tests N`` the
level is 5% / N (Bonferroni). With ``--difference D`` the last column has the seeds that find a true
difference D. The trials count as independent. The power is exact, from the noncentral t
distribution.
"""

from __future__ import annotations

import argparse
import math

import pandas as pd
from scipy import optimize, stats

POWER = 0.8
SEEDS = (3, 5, 6, 10, 20)


def power(difference: float, seeds: int, level: float) -> float:
    """Return the power of a two-sided t test of two groups; the difference is in standard deviations."""
    degrees, shift = 2 * seeds - 2, difference * math.sqrt(seeds / 2.0)
    critical = stats.t.ppf(1.0 - level / 2.0, degrees)
    wrong_sign = float(stats.nct.cdf(-critical, degrees, shift))  # NaN where it is nearly 0
    return float(1.0 - stats.nct.cdf(critical, degrees, shift)) + (
        0.0 if math.isnan(wrong_sign) else wrong_sign
    )


def detectable(seeds: int, level: float) -> float:
    """Return the difference, in standard deviations, that is found with probability POWER."""
    reach = 1.0 / math.sqrt(seeds)
    while power(reach, seeds, level) < POWER:
        reach *= 1.2
    return float(optimize.brentq(lambda difference: power(difference, seeds, level) - POWER, 0.0, reach))


def seeds_for(difference: float, level: float) -> int:
    """Return the smallest number of seeds that finds a difference, in standard deviations, above 0."""
    seeds = 2
    while power(difference, seeds, level) < POWER:
        seeds += 1
    return seeds


def pooled(returns: pd.DataFrame) -> tuple[float, int]:
    """Return the standard deviation, pooled over groups, and its degrees of freedom."""
    groups = returns.groupby(["agent", "method"])["return"]
    squares = groups.apply(lambda group: ((group - group.mean()) ** 2).sum())
    degrees = int((groups.size() - 1).sum())
    return (math.sqrt(squares.sum() / degrees) if degrees else math.nan), degrees


def main() -> None:
    parser = argparse.ArgumentParser(description="How large a difference some seeds can show.")
    parser.add_argument("tables", nargs="+", help="CSV files of final policies")
    parser.add_argument("--agents", nargs="+", metavar="LABEL", help="default: all")
    parser.add_argument("--tests", type=int, default=1, help="the number of tests; default: 1")
    parser.add_argument("--difference", type=float, metavar="D", help="of two mean returns, above 0")
    given = parser.parse_args()
    level = 0.05 / given.tests
    read = pd.concat([pd.read_csv(path) for path in given.tables], ignore_index=True)
    rows = read[read["policy"] == "stochastic"].drop_duplicates(["task", "agent", "method", "seed", "return"])
    if given.agents:
        rows = rows[rows["agent"].isin(given.agents)]
    units = {seeds: detectable(seeds, level) for seeds in SEEDS}
    print("differences in standard deviations:")
    print("  ", ", ".join(f"{unit:.2f} with {seeds} seeds" for seeds, unit in units.items()))
    needed = f"{f'for {given.difference:g}':>12}" if given.difference else ""
    print(f"{'task':14}{'s':>7}{'(degrees)':>11}" + "".join(f"{seeds:>4} seeds" for seeds in SEEDS) + needed)
    for task, returns in rows.groupby("task"):
        spread, degrees = pooled(returns)
        shown = "".join(f"{spread * unit:>10.1f}" for unit in units.values())
        known = given.difference and spread > 0.0
        needed = f"{seeds_for(given.difference / spread, level):>12}" if known else ""
        print(f"{task:14}{spread:7.2f}{degrees:11}" + shown + needed)


if __name__ == "__main__":
    main()
