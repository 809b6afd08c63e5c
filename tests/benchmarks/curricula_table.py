"""The table of an experiment with curricula: final policies under each, and their differences in return.

    python -m tests.benchmarks.curricula_table results/velocity/six-agents.csv results/velocity/curricula.csv

The tables are those of ``final_policies.py``; only seeds count that an agent has under every curriculum,
two or more. A cell is mean return / mean cost over seeds, with one standard error of the cost: over seeds or
over all episodes, whichever is larger. The last columns have the difference in return from ``none``, paired
by seed, with Student's 95% interval. ``differences.py`` prints those in cost, and corrects for their number.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd

from recrl.analysis.statistics.intervals import paired_difference
from tests.benchmarks.velocity_table import Cell, number

BASELINE = "none"


def lines(rows: pd.DataFrame, curricula: Sequence[str], limit: float) -> Iterator[str]:
    """Yield the lines of one kind of policy: the table, and how many exceed the limit."""
    others = [each for each in curricula if each != BASELINE]
    heads = [f"`{each}`" for each in curricula] + [f"`{each}` - `{BASELINE}`" for each in others]
    yield "| task | agent | " + " | ".join(heads) + " |"
    yield "|---" * (2 + len(heads)) + "|"
    complete = []
    for (task, agent), all_seeds in rows.groupby(["task", "agent"]):
        wide = all_seeds.pivot(index="seed", columns="method", values="return").reindex(
            columns=list(curricula)
        )
        wide = wide.dropna()
        if len(wide) < 2:
            continue
        group = all_seeds[all_seeds["seed"].isin(wide.index)]
        complete.append(group)
        short = str(task).removeprefix("Safety").removesuffix("Velocity")
        cells = [Cell.of(short, str(agent), group[group["method"] == each]) for each in curricula]
        texts = [f"{number(cell.episode_return)} / {cell.costs}" for cell in cells]
        for each in others:
            it = paired_difference(wide[each].to_numpy(), wide[BASELINE].to_numpy())
            texts.append(f"{number(it.estimate)} ({number(it.low)} to {number(it.high)})")
        yield f"| {short} | `{agent}` | " + " | ".join(texts) + " |"
    counted = pd.concat(complete)
    over = counted["cost"] - limit > counted["cost_se"]
    for each in curricula:
        is_of = counted["method"] == each
        tasks = counted.loc[is_of & over, "task"].value_counts()
        where = ", ".join(f"{count} {task}" for task, count in tasks.items()) or "-"
        count = f"{(is_of & over).sum()} of {is_of.sum()}"
        yield f"more than one standard error above the limit under {each}: {count} ({where})"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables of the stochastic policies, then those of the deterministic ones."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tables", nargs="+", type=Path)
    parser.add_argument("--curricula", nargs="+", default=[BASELINE, "linear", "dynamic"])
    parser.add_argument("--limit", type=float, default=25.0)
    given = parser.parse_args(arguments)
    rows = pd.concat([pd.read_csv(path, comment="#") for path in given.tables], ignore_index=True)
    rows = rows[rows["method"].isin(given.curricula)]
    for policy in ("stochastic", "deterministic"):
        print(f"\n{policy}\n")
        print("\n".join(lines(rows[rows["policy"] == policy], given.curricula, given.limit)))


if __name__ == "__main__":
    main()
