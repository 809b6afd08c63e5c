"""Final policies on Safety Gym beside all of OmniSafe's published agents that know the limit.

    R=results/safety-gym
    python -m tests.benchmarks.published_comparison $R/agents.csv $R/margin-half.csv $R/margin.csv

Each table is one of ``final_policies.py``, of one agent. Policies are judged at a limit of 25, whatever limit
they were trained under. The return has Student's 95% interval over seeds. The cost has one standard error,
over seeds or over all episodes, whichever is larger. An agent keeps the limit if its mean cost is at most one
standard error above it.

OmniSafe's evaluator stops an episode of its two early-terminated agents when its cost has reached the limit.
That is another task, so they are not among the others but have a column of their own. What the number after
the +- is, OmniSafe does not say. It is taken for a standard deviation over five seeds in two places: for
whether a published agent keeps the limit, and in Welch's one-sided test, which is corrected for the tasks by
Holm's method. The intervals take the published mean as exact.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats

from recrl.analysis.statistics.intervals import holm
from tests.benchmarks.velocity_table import LIMIT, Cell

PUBLISHED = Path("results/safety-gym/published.csv")
PUBLISHED_SEEDS = 5
SIGNIFICANT = 0.05

Agent = Mapping[str, Any]  # a row of the published table


def groups(published: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """The published agents on one task by what they are compared as; a group may be empty."""
    stops = published["agent"].str.endswith("EarlyTerminated")
    whole = published[~stops]
    error = whole["cost_spread"] / math.sqrt(PUBLISHED_SEEDS)
    return {
        "all": whole,
        "PPO-Lag, CPO and TRPO-Lag": whole[whole["agent"].isin(["PPO-Lag", "CPO", "TRPO-Lag"])],
        "all that keep the limit": whole[whole["cost"] <= LIMIT + error],
        "all with a mean cost of at most the limit": whole[whole["cost"] <= LIMIT],
        "the two stopped at the limit": published[stops],
    }


@dataclass(frozen=True)
class Comparison:
    """Our policies on one task, and the best published agent of each group; None where it is empty."""

    ours: Cell
    best: Mapping[str, Agent | None]
    p_value: float

    def above(self, group: str) -> bool:
        """Whether our mean return is above those of a group of published agents."""
        agent = self.best[group]
        return agent is None or self.ours.episode_return > agent["return"]

    def interval_above(self, group: str) -> bool:
        """Whether the lower end of our interval is."""
        agent = self.best[group]
        return agent is None or self.ours.episode_return - self.ours.half_width > agent["return"]

    @property
    def keeps_limit(self) -> bool:
        """Whether our mean cost is at most one standard error above the limit."""
        return self.ours.cost <= LIMIT + self.ours.cost_error


def best_of(agents: pd.DataFrame) -> Agent | None:
    """The agent that earns most; none of an empty table."""
    rows = agents.sort_values("return").to_dict("records")
    return {str(key): value for key, value in rows[-1].items()} if rows else None


def compared(task: str, rows: pd.DataFrame, published: pd.DataFrame) -> Comparison:
    """Compare our policies on a task, a row a seed, with the published agents on it."""
    best = {name: best_of(agents) for name, agents in groups(published).items()}
    rival = best["all"]
    assert rival is not None
    test = stats.ttest_ind_from_stats(
        rows["return"].mean(),
        rows["return"].std(),
        len(rows),
        rival["return"],
        rival["return_spread"],
        PUBLISHED_SEEDS,
        equal_var=False,
        alternative="greater",
    )
    return Comparison(Cell.of(task, "", rows), best, float(test.pvalue))


def published_text(agent: Agent | None) -> str:
    """Return, cost and name of a published agent."""
    if agent is None:
        return "none"
    return f"{agent['return']:.1f} / {agent['cost']:.1f} ({agent['agent']})"


def print_comparison(comparisons: Sequence[Comparison]) -> None:
    """Print a row a task, and on how many tasks what holds."""
    shown = ("all", "all that keep the limit", "the two stopped at the limit")
    print(f"| task | return | cost | best of {' | best of '.join(shown)} |")
    print("|---|---|---|---|---|---|")
    for one in comparisons:
        theirs = " | ".join(published_text(one.best[group]) for group in shown)
        print(f"| {one.ours.task} | {one.ours.interval} | {one.ours.costs} | {theirs} |")
    significant = holm(np.array([one.p_value for one in comparisons])) < SIGNIFICANT
    counts = {
        f"mean return above {group}": [one.above(group) for one in comparisons]
        for group in comparisons[0].best
    }
    counts |= {
        "interval above all": [one.interval_above("all") for one in comparisons],
        "above all by Welch's test, corrected": significant.tolist(),
        "mean cost keeps the limit": [one.keeps_limit for one in comparisons],
        "above all that keep the limit, and the limit kept": [
            one.above("all that keep the limit") and one.keeps_limit for one in comparisons
        ],
        "above all with a mean cost of at most the limit, and ours is, too": [
            one.above("all with a mean cost of at most the limit") and one.ours.cost <= LIMIT
            for one in comparisons
        ],
    }
    for text, held in counts.items():
        print(f"{text}: {sum(held)} of {len(held)}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a comparison for each table and each kind of policy."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tables", nargs="+", type=Path)
    parser.add_argument("--published", type=Path, default=PUBLISHED)
    given = parser.parse_args(arguments)
    published = dict(list(pd.read_csv(given.published, comment="#").groupby("task")))
    for table in given.tables:
        rows = pd.read_csv(table, comment="#")
        for policy in ("stochastic", "deterministic"):
            chosen = rows[(rows["policy"] == policy) & rows["task"].isin(list(published))]
            if chosen.duplicated(["task", "seed"]).any():
                raise SystemExit(f"{table}: a task and seed is there twice")
            seeds = chosen.groupby("task")["seed"].nunique().min()
            print(f"\n{table}, {policy}, at least {seeds} seeds a task\n")
            print_comparison(
                [compared(str(task), group, published[task]) for task, group in chosen.groupby("task")]
            )


if __name__ == "__main__":
    main()
