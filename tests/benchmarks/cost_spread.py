"""How far the costs of final policies scatter about the limit, beyond the error of their evaluation.

    python tests/benchmarks/cost_spread.py results/safety-gym/agents.csv --limit 25 --without CarPush2

The variance of the true costs is that of the measured ones less the mean of their squared standard errors,
over all tasks and seeds together. The chance is the probability that the measured mean cost of a task's
policies is at most one standard error above the limit, if their true costs are normally distributed about it.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from recrl.environments.cmdp import Floats

REPLICATIONS = 20_000


def spread(costs: Floats, errors: Floats) -> float:
    """The standard deviation of the true costs."""
    return math.sqrt(max(0.0, costs.var(ddof=1) - (errors**2).mean()))


def bootstrap(costs: Floats, errors: Floats) -> Floats:
    """The ends of the percentile interval of the spread, over policies."""
    drawn = np.random.default_rng(0).integers(len(costs), size=(REPLICATIONS, len(costs)))
    return np.percentile([spread(costs[rows], errors[rows]) for rows in drawn], [2.5, 97.5])


def chance(spread_of_one: float, error: float, policies: int) -> float:
    """That the measured mean cost of some policies is at most one standard error above the limit."""
    return float(stats.norm.cdf(error / math.hypot(spread_of_one / math.sqrt(policies), error)))


def main() -> None:
    """Print the spread and the chances."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("table", type=Path, help="of final_policies.py")
    parser.add_argument("--limit", type=float, required=True)
    parser.add_argument("--without", nargs="*", default=[], help="tasks without a chance")
    arguments = parser.parse_args()
    rows = pd.read_csv(arguments.table, comment="#").query("policy == 'stochastic'")
    costs, errors = rows["cost"].to_numpy(), rows["cost_se"].to_numpy()
    of_one, (low, high) = spread(costs, errors), bootstrap(costs, errors)
    print(f"{len(costs)} policies, mean cost {costs.mean():.2f} +- {stats.sem(costs):.2f}")
    print(f"above the limit: {(costs > arguments.limit).sum()}")
    print(f"spread of the true costs: {of_one:.2f} (bootstrap 95%: {low:.1f} to {high:.1f})")
    judged = rows[~rows["task"].isin(arguments.without)].groupby("task")["cost_se"]
    policies = int(judged.size().iloc[0])
    error = float(judged.apply(lambda each: math.sqrt((each**2).sum()) / len(each)).mean())
    print(f"standard error of the mean of {policies} policies: {error:.2f}")
    for name, value in (("with this spread", of_one), ("without any", 0.0)):
        one = chance(value, error, policies)
        print(f"chance {name}: {one:.2f} of one task, {one**judged.ngroups:.2f} of all {judged.ngroups}")


if __name__ == "__main__":
    main()
