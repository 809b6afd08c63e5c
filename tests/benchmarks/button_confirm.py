"""Judge the confirmation on CarButton2 by the rule in results/safety-gym/button-confirm.yaml.

    python -m tests.benchmarks.button_confirm results/safety-gym/button-confirm.csv \
        --earlier results/safety-gym/curricula-today.csv results/safety-gym/table.csv

The tables are those of ``final_policies.py``. Prints whether each pair earns more under ``linear``, and
whether its mean cost is at most 25 plus one standard error, over seeds or over all episodes, whichever is
larger. Then come the differences in return and cost, with 95% intervals, paired (Student) and as two groups
(Welch), of these seeds, of these with the first earlier table, and of all.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from recrl.analysis.statistics.intervals import group_difference, paired_difference
from tests.benchmarks.velocity_table import Cell

TASK, AGENT, LIMIT = "CarButton2", "ppo-lag", 25.0
PLANNED = [120, 121, 122]


def pairs(rows: pd.DataFrame, policy: str) -> pd.DataFrame:
    """Return a row a seed, with the columns (return or cost, none or linear)."""
    chosen = _of_question(rows, policy)
    return chosen.pivot(index="seed", columns="method", values=["return", "cost"]).dropna()


def _of_question(rows: pd.DataFrame, policy: str) -> pd.DataFrame:
    chosen = rows[(rows["task"] == TASK) & (rows["agent"] == AGENT) & (rows["policy"] == policy)]
    return chosen[chosen["method"].isin(["none", "linear"])]


def verdict(rows: pd.DataFrame) -> Iterator[str]:
    """Yield the two conditions of the rule, for the final stochastic policies."""
    seeds = pairs(rows, "stochastic")
    if seeds.index.tolist() != PLANNED:
        raise SystemExit(f"the planned seeds are {PLANNED}, complete are {seeds.index.tolist()}")
    earned = seeds["return", "linear"] - seeds["return", "none"]
    question = _of_question(rows, "stochastic")
    cell = Cell.of(TASK, AGENT, question[question["method"] == "linear"])
    each = ", ".join(f"{value:.2f} (seed {seed})" for seed, value in earned.items())
    yield f"return under linear above none: {each}: {(earned > 0).sum()} of {len(earned)} pairs earn more"
    keeps = cell.cost <= LIMIT + cell.cost_error
    yield f"mean cost under linear: {cell.costs}: {'keeps' if keeps else 'exceeds'} the limit of {LIMIT:g}"
    yield f"the rule is {'met' if keeps and (earned > 0).all() else 'not met'}"


def intervals(seeds: pd.DataFrame) -> Iterator[str]:
    """Yield the differences of linear from none, paired and as two groups."""
    for column in ("return", "cost"):
        linear, none = seeds[column, "linear"].to_numpy(), seeds[column, "none"].to_numpy()
        pairs, groups = paired_difference(linear, none), group_difference(linear, none)
        both = f"paired {pairs.low:.2f} to {pairs.high:.2f}; Welch {groups.low:.2f} to {groups.high:.2f}"
        yield f"  {column}: {pairs.estimate:.2f} ({both})"


def main() -> None:
    """Print the verdict and the intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("fresh", type=Path)
    parser.add_argument("--earlier", type=Path, nargs="+", required=True)
    given = parser.parse_args()
    fresh = pd.read_csv(given.fresh)
    tables = [fresh, *map(pd.read_csv, given.earlier)]
    print("\n".join(verdict(fresh)))
    for policy in ("stochastic", "deterministic"):
        for number in range(len(tables)):
            seeds = pairs(pd.concat(tables[: number + 1]), policy)
            print(f"{policy}, linear minus none, seeds {', '.join(map(str, seeds.index))}:")
            print("\n".join(intervals(seeds)))


if __name__ == "__main__":
    main()
