"""Final policies on Safety Gym beside all of OmniSafe's published agents that know the limit.

    R=results/safety-gym
    python -m tests.benchmarks.published_comparison $R/agents.csv $R/margin-half.csv $R/margin.csv

Each table of ``final_policies.py`` is one comparison; joined by a plus sign, ``a.csv+b.csv``, they are one.
Policies are judged at a limit of 25, whatever limit they were trained under. The cost has one standard error,
over seeds or over all episodes, whichever is larger; the return has Student's 95% interval over seeds. An
agent keeps the limit if its mean cost is at most one standard error above it.

OmniSafe's evaluator stops an episode of its two early-terminated agents when its cost has reached the limit.
That is another task, so they are not among the others but have a column of their own. What the number after
the +- is, OmniSafe does not say. It is taken for a standard deviation over five seeds in two places: for
whether a published agent keeps the limit, and in the last count. That is Welch's one-sided test, corrected
for the tasks by Holm's method. The intervals take the published mean as exact.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from tests.benchmarks.differences import holm
from tests.benchmarks.velocity_table import LIMIT, Cell

PUBLISHED = Path("results/safety-gym/published.csv")
PUBLISHED_SEEDS = 5
SIGNIFICANT = 0.05
STOPPED = ("PPOEarlyTerminated", "TRPOEarlyTerminated")
THREE = ("PPO-Lag", "CPO", "TRPO-Lag")


@dataclass(frozen=True)
class Comparison:
    """Our policies on one task, and the published agents to compare them with; each may be missing."""

    ours: Cell
    best: dict[str, Any]
    best_of_three: dict[str, Any] | None
    best_within: dict[str, Any] | None
    best_at_most_limit: dict[str, Any] | None
    best_stopped: dict[str, Any] | None
    p_value: float

    def above(self, agent: dict[str, Any] | None) -> bool:
        """Whether our mean return is above that of a published agent; true if there is none."""
        return agent is None or self.ours.episode_return > agent["return"]

    @property
    def keeps_limit(self) -> bool:
        """Whether our mean cost is at most one standard error above the limit."""
        return self.ours.cost <= LIMIT + self.ours.cost_error


def best_of(agents: pd.DataFrame) -> dict[str, Any] | None:
    """The agent that earns most; none of an empty table."""
    rows = agents.sort_values("return").to_dict("records")
    return {str(key): value for key, value in rows[-1].items()} if rows else None


def compared(task: str, rows: pd.DataFrame, published: pd.DataFrame) -> Comparison | None:
    """The comparison on one task; none if nothing is published for it."""
    of_task = published[published["task"] == task]
    stopped = of_task["agent"].isin(STOPPED)
    keeps_limit = of_task["cost"] <= LIMIT + of_task["cost_spread"] / math.sqrt(PUBLISHED_SEEDS)
    best = best_of(of_task[~stopped])
    if best is None:
        return None
    test = stats.ttest_ind_from_stats(
        rows["return"].mean(),
        rows["return"].std(),
        len(rows),
        best["return"],
        best["return_spread"],
        PUBLISHED_SEEDS,
        equal_var=False,
        alternative="greater",
    )
    return Comparison(
        Cell.of(task, "", rows),
        best,
        best_of(of_task[of_task["agent"].isin(THREE)]),
        best_of(of_task[~stopped & keeps_limit]),
        best_of(of_task[~stopped & (of_task["cost"] <= LIMIT)]),
        best_of(of_task[stopped]),
        float(test.pvalue),
    )


def published_text(agent: dict[str, Any] | None) -> str:
    """Return, cost and name of a published agent."""
    if agent is None:
        return "none"
    return f"{agent['return']:.1f} / {agent['cost']:.1f} ({agent['agent']})"


def print_comparison(comparisons: Sequence[Comparison]) -> None:
    """Print a row a task, and on how many tasks what holds."""
    print("| task | return | cost | best published | best that keeps the limit | stopped at the limit |")
    print("|---|---|---|---|---|---|")
    for one in comparisons:
        theirs = " | ".join(map(published_text, (one.best, one.best_within, one.best_stopped)))
        print(f"| {one.ours.task} | {one.ours.interval} | {one.ours.costs} | {theirs} |")
    corrected = holm(np.array([one.p_value for one in comparisons]))
    intervals = [one.ours.episode_return - one.ours.half_width > one.best["return"] for one in comparisons]
    counts = {
        "mean return above PPO-Lag, CPO and TRPO-Lag": [one.above(one.best_of_three) for one in comparisons],
        "mean return above all": [one.above(one.best) for one in comparisons],
        "its interval, too": intervals,
        "above all by Welch's test, corrected": list(corrected < SIGNIFICANT),
        "mean cost keeps the limit": [one.keeps_limit for one in comparisons],
        "mean return above all that keep the limit": [one.above(one.best_within) for one in comparisons],
        "that, and the limit kept": [one.above(one.best_within) and one.keeps_limit for one in comparisons],
        "above all with a mean cost of at most the limit, and ours is, too": [
            one.above(one.best_at_most_limit) and one.ours.cost <= LIMIT for one in comparisons
        ],
        "mean return above the two stopped at the limit": [
            one.above(one.best_stopped) for one in comparisons
        ],
    }
    for text, held in counts.items():
        print(f"{text}: {sum(map(bool, held))} of {len(held)}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a comparison for each table and each kind of policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tables", nargs="+", help="tables of final policies, of one agent each")
    parser.add_argument("--published", type=Path, default=PUBLISHED)
    given = parser.parse_args(arguments)
    published = pd.read_csv(given.published, comment="#")
    for joined in given.tables:
        rows = pd.concat([pd.read_csv(path, comment="#") for path in joined.split("+")], ignore_index=True)
        for policy in ("stochastic", "deterministic"):
            chosen = rows[rows["policy"] == policy]
            if chosen.duplicated(["task", "seed"]).any():
                raise SystemExit(f"{joined}: a task and seed is there twice")
            found = [compared(str(task), group, published) for task, group in chosen.groupby("task")]
            print(f"\n{joined}, {policy}, {chosen.groupby('task')['seed'].nunique().min()} or more seeds\n")
            print_comparison([one for one in found if one is not None])


if __name__ == "__main__":
    main()
