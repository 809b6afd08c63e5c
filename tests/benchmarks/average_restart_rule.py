"""Apply the rule of ``average-restart.yaml`` to the two tables of ``average_restart.py``.

    python -m tests.benchmarks.average_restart_rule results/velocity/average-restart.csv \
        results/rivergrid/average-restart.csv

Intervals are Student's 95%, paired by trial: all policies of a trial are from the same training.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
from scipy import stats

from recrl.analysis.data.labels import KEY
from tests.benchmarks.solved_pairs import judged, mcnemar

BASE = "average"


def difference(wide: pd.DataFrame, policy: str) -> str:
    """Return the mean over trials of ``policy`` less the average, with its interval.

    Args:
        wide: a row a trial, a column a policy.
        policy: the column that is compared.
    """
    each = wide[policy] - wide[BASE]
    low, high = stats.t.interval(0.95, len(each) - 1, each.mean(), stats.sem(each))
    return f"{policy} - {BASE} {each.mean():.2f} ({low:.2f} to {high:.2f})"


def evaluated_by_episodes(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the means of the three policies and their differences, over all trials and by agent.

    Args:
        rows: a row a trial and policy, with its return, cost and limit.
    """
    rows = rows.assign(
        excess=(rows["cost"] - rows["limit"]).clip(lower=0.0), above=rows["cost"] > 1.1 * rows["limit"]
    )
    for name, part in [("all", rows), *rows.groupby("agent")]:
        yield f"{name}, {len(part) // 3} trials"
        yield f"  more than 10% above the limit: {part.groupby('policy')['above'].sum().to_dict()}"
        for column in ("excess", "cost", "return"):
            wide = part.pivot(index=list(KEY), columns="policy", values=column)
            means = ", ".join(f"{policy} {mean:.2f}" for policy, mean in wide.mean().items())
            yield f"  {column}: {means}"
            yield from (f"    {difference(wide, policy)}" for policy in ("restarted", "last"))


def evaluated_exactly(rows: pd.DataFrame) -> Iterator[str]:
    """Yield how many trials each policy solves, and those that only one of two solves.

    Args:
        rows: of ``solved_pairs.judged``.
    """
    for name, part in [("all", rows), *rows.groupby(["task", "agent"])]:
        wide = part.pivot(index=list(KEY), columns="policy", values="solved").astype(bool)
        label = name if isinstance(name, str) else " ".join(name)
        yield f"{label}, solved of {len(wide)}: {wide.sum().to_dict()}"
        for policy in ("restarted", "last"):
            only = (wide[policy] & ~wide[BASE]).sum(), (wide[BASE] & ~wide[policy]).sum()
            yield f"    solved by one of two: {mcnemar(policy, BASE, *map(int, only))}"


def main() -> None:
    """Read and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("velocity", type=Path)
    parser.add_argument("rivergrid", type=Path)
    arguments = parser.parse_args()
    print("\n".join(evaluated_by_episodes(pd.read_csv(arguments.velocity))))
    print()
    print("\n".join(evaluated_exactly(judged(pd.read_csv(arguments.rivergrid)))))


if __name__ == "__main__":
    main()
