"""How much of the variance of value targets critics explain on rollouts that they have not learnt from yet.

    python tests/benchmarks/explained_variance.py results/safety-gym/curricula-today.zip [SWEEP ...]

Printed: the mean over the updates of the second half of the steps, a row for each task, agent and curriculum,
with the smallest and the largest mean of a trial. 1 is a perfect critic; a constant explains 0.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

import recrl

KEYS = ["task", "agent", "method"]
COLUMNS = {"reward": "explained_variance_reward", "cost": "explained_variance_cost_0"}


def late_means(updates: pd.DataFrame) -> pd.DataFrame:
    """Return the mean of each trial over the second half of its steps."""
    trials = [*KEYS, "seed"]
    steps = updates.groupby(trials, observed=True)["end_step"].transform("max")
    late = updates[updates["end_step"] > steps / 2]
    return late.groupby(trials, observed=True)[list(COLUMNS.values())].mean()


def main() -> None:
    """Print the table of some sweeps."""
    parser = argparse.ArgumentParser(description="What critics explain of fresh rollouts.")
    parser.add_argument("sweeps", nargs="+", type=Path)
    sweeps = parser.parse_args().sweeps
    trials = late_means(pd.concat([recrl.load_sweep(path).updates for path in sweeps], ignore_index=True))
    groups = trials.groupby(KEYS, observed=True)
    table: dict[str, object] = {"n": groups.size()}
    for name, column in COLUMNS.items():
        each = groups[column]
        cells = zip(each.mean(), each.min(), each.max(), strict=True)
        table[name] = [f"{mean:.2f} ({low:.2f} to {high:.2f})" for mean, low, high in cells]
    print(pd.DataFrame(table, groups.size().index).to_string())


if __name__ == "__main__":
    main()
