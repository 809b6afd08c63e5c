"""Solved trials of RiverGrid by curriculum, and the pairs of equal seeds that only one of two solves.

    python -m tests.benchmarks.solved_pairs results/rivergrid/today.csv --compare dynamic none

The tables are those of ``average_or_last.py``. Solved: a cost at most 1% above the limit, and a return within
0.2 of the optimum. p is that of McNemar's exact test, which takes the pairs as independent.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd
from scipy.stats import binomtest

from recrl.analysis.statistics.verdicts import solved
from recrl.environments.cmdp import CostLimits
from recrl.environments.registry import optimal_return

PAIR = ["task", "agent", "seed"]


def judged(rows: pd.DataFrame) -> pd.DataFrame:
    """The rows with a column ``solved``.

    Args:
        rows: task, limit, return and cost of exactly evaluated policies.
    """
    optima = {
        (task, limit): optimal_return(str(task), {}, CostLimits((float(limit),)))
        for task, limit in rows[["task", "limit"]].drop_duplicates().itertuples(index=False)
    }
    optimum = pd.Series([optima[key] for key in zip(rows["task"], rows["limit"], strict=True)], rows.index)
    measured = pd.DataFrame(
        {"gap": optimum - rows["return"], "cost_0": rows["cost"], "deploy_limit_0": rows["limit"]}
    )
    return rows.assign(solved=solved(measured))


def lines(rows: pd.DataFrame, first: str, second: str) -> Iterator[str]:
    """Yield the counts of one kind of policy.

    Args:
        rows: of ``judged``.
        first: a curriculum.
        second: another one, with the same seeds.
    """
    counts = rows.groupby(["method", "task", "agent"])["solved"].sum()
    yield counts.unstack(["task", "agent"]).to_string()
    pairs = rows.pivot(index=PAIR, columns="method", values="solved")[[first, second]].dropna().astype(bool)
    only = pd.DataFrame(
        {first: pairs[first] & ~pairs[second], second: pairs[second] & ~pairs[first]}, dtype=int
    )
    yield f"pairs that only one solves, of {len(pairs)}:"
    yield only.groupby(["task", "agent"]).sum().to_string()
    yield f"together: {mcnemar(first, second, *only.sum())}"


def mcnemar(first: str, second: str, only_first: int, only_second: int) -> str:
    """Return how many only one of two solves, and the exact p value."""
    both = only_first + only_second
    p = float(binomtest(only_first, both).pvalue) if both else 1.0
    return f"{first} {only_first}, {second} {only_second}, exact p {p:.4f}"


def kinds_of_policy(rows: pd.DataFrame) -> Iterator[str]:
    """Yield how many trials, or more trials of a seed, only the average or only the last policy solves.

    Args:
        rows: of ``judged``.
    """
    wide = rows.pivot(index=[*PAIR, "method"], columns="policy", values="solved")
    wide = wide[["average", "last"]].dropna().astype(bool)
    for agent, trials in wide.groupby("agent"):
        average, last = trials["average"], trials["last"]
        counts = int((average & ~last).sum()), int((last & ~average).sum())
        yield f"{agent}: {mcnemar('average', 'last', *counts)}"
        by_seed = (average.astype(int) - last.astype(int)).groupby("seed").sum()
        more = int((by_seed > 0).sum()), int((by_seed < 0).sum())
        yield f"{agent}, seeds with which one solves more: {mcnemar('average', 'last', *more)}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the counts of the averaged and of the last policies, and of trials in which they differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tables", nargs="+", type=Path, metavar="TABLE")
    parser.add_argument("--compare", nargs=2, default=["dynamic", "none"], metavar="CURRICULUM")
    parser.add_argument("--task", help="only this map, rivergrid-1a or rivergrid-1b")
    given = parser.parse_args(arguments)
    rows = judged(pd.concat([pd.read_csv(table) for table in given.tables], ignore_index=True))
    rows = rows[rows["task"] == given.task] if given.task else rows
    for policy in ("average", "last"):
        chosen = rows[rows["policy"] == policy]
        print(f"\n{policy}: {int(chosen['solved'].sum())} of {len(chosen)} solved")
        print("\n".join(lines(chosen, *given.compare)))
    print(f"\ntrials of which only one policy solves, of {len(rows) // 2}:")
    print("\n".join(kinds_of_policy(rows)))


if __name__ == "__main__":
    main()
