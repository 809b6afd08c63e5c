"""The table of the velocity tasks: our agents beside the best published ones that keep the limit.

    cd results/velocity
    python ../../tests/benchmarks/velocity_table.py six-agents.csv --published published.csv

The tables are those of ``final_policies.py``. A cell is mean return / mean cost over seeds, with one
standard error of the cost: over seeds or over all episodes, whichever is larger. An agent keeps the limit
on a task if its mean cost is at most the limit. Of those agents the one that earns most is shown, with
Student's 95% interval of its mean over seeds, which does not allow for the choice. Beside it is the best of
the published agents that keep the limit.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from recrl.environments.cmdp import Floats

LIMIT = 25.0
AGENTS = ("ppo-lag", "trpo-lag", "cpo", "pcpo", "focops", "p3o")


@dataclass(frozen=True)
class Cell:
    """One agent on one task: means over seeds, half of the return's interval, the error of the cost."""

    task: str
    agent: str
    episode_return: float
    half_width: float
    cost: float
    cost_error: float

    @classmethod
    def of(cls, task: str, agent: str, rows: pd.DataFrame) -> Cell:
        """Average the policies of one agent on one task, a row a seed."""
        returns, costs, errors = rows[["return", "cost", "cost_se"]].to_numpy(np.float64).T
        over_episodes = float(np.linalg.norm(errors)) / len(rows)
        cost_error = float(np.fmax(over_episodes, standard_error(costs)))
        half_width = float(stats.t.ppf(0.975, len(rows) - 1)) * standard_error(returns)
        return cls(task, agent, float(returns.mean()), half_width, float(costs.mean()), cost_error)

    @property
    def interval(self) -> str:
        """The mean return with its interval; with one seed there is none."""
        if math.isnan(self.half_width):
            return number(self.episode_return)
        ends = self.episode_return - self.half_width, self.episode_return + self.half_width
        return f"{number(self.episode_return)} ({number(ends[0])} to {number(ends[1])})"

    @property
    def costs(self) -> str:
        """The mean cost with its error."""
        return f"{self.cost:.1f} +- {self.cost_error:.1f}"


def standard_error(values: Floats) -> float:
    """One standard error of a mean; NaN for a single value."""
    return float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def number(value: float) -> str:
    """A return: whole from 100 on, else with one decimal."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.1f}"


def cells(rows: pd.DataFrame) -> dict[str, dict[str, Cell]]:
    """The cells of each task, by agent."""
    found: dict[str, dict[str, Cell]] = {}
    for (name, agent), group in rows.groupby(["task", "agent"]):
        task = str(name).removeprefix("Safety").removesuffix("Velocity")
        found.setdefault(task, {})[str(agent)] = Cell.of(task, str(agent), group)
    return found


def best_published(published: pd.DataFrame, task: str) -> str:
    """Return / cost and the name of the published agent that keeps the limit and earns most."""
    kept = published[(published["task"] == task) & (published["cost"] <= LIMIT)].to_dict("records")
    if not kept:
        return "none"
    best = max(kept, key=lambda row: float(row["return"]))
    return f"{number(float(best['return']))} / {best['cost']:.1f} ({best['agent']})"


def print_tables(rows: pd.DataFrame, published: pd.DataFrame) -> None:
    """Print all agents, the best one within the limit, and how often the limit is kept."""
    table = cells(rows)
    print("| task | " + " | ".join(f"`{agent}`" for agent in AGENTS) + " |")
    print("|---" * (len(AGENTS) + 1) + "|")
    for task, agents in table.items():
        texts = [
            f"{number(agents[a].episode_return)} / {agents[a].costs}" if a in agents else "not run"
            for a in AGENTS
        ]
        print(f"| {task} | " + " | ".join(texts) + " |")
    print("\n| task | best within the limit | return | cost | published best within the limit |")
    print("|---|---|---|---|---|")
    for task, agents in table.items():
        kept = [cell for cell in agents.values() if cell.cost <= LIMIT]
        theirs = best_published(published, task)
        if not kept:
            print(f"| {task} | none |  |  | {theirs} |")
            continue
        best = max(kept, key=lambda cell: cell.episode_return)
        print(f"| {task} | `{best.agent}` | {best.interval} | {best.costs} | {theirs} |")
    print("\nTasks on which the mean cost is at most the limit:")
    for agent in AGENTS:
        of = [agents[agent] for agents in table.values() if agent in agents]
        print(f"  {agent}: {sum(cell.cost <= LIMIT for cell in of)} of {len(of)}")
    over = rows[rows["cost"] - LIMIT > rows["cost_se"]]
    print(f"Policies more than one standard error above the limit: {len(over)} of {len(rows)}")
    if len(over):
        print(over[["task", "agent", "seed", "cost", "cost_se"]].to_string(index=False))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables of the stochastic policies, then those of the deterministic ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tables", nargs="+", type=Path)
    parser.add_argument("--published", type=Path, required=True)
    given = parser.parse_args(arguments)
    rows = pd.concat([pd.read_csv(path, comment="#") for path in given.tables], ignore_index=True)
    published = pd.read_csv(given.published, comment="#")
    for policy in ("stochastic", "deterministic"):
        chosen = rows[rows["policy"] == policy]
        seeds = chosen.groupby(["task", "agent"])["seed"]
        if (seeds.count() > seeds.nunique()).any():
            raise SystemExit("a task, agent and seed is in the tables twice")
        print(f"\n{policy}, {seeds.count().min()} to {seeds.count().max()} seeds\n")
        print_tables(chosen, published)


if __name__ == "__main__":
    main()
