"""What the final policies of a sweep earn and cost: a row a trial and policy, from its evaluation.

python tests/benchmarks/final_policies.py runs/safety-gym-agents --to results/safety-gym/agents.csv
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pandas as pd

import recrl

KEYS = ["task", "agent", "method", "seed", "policy"]


def final_policies(sweep: Path) -> pd.DataFrame:
    """Means over the episodes of each evaluation, with standard errors; complete trials only."""
    loaded = recrl.load_sweep(sweep)
    if loaded.num_costs > 1:
        raise SystemExit(f"{sweep}: has {loaded.num_costs} costs; the table has one")
    complete = loaded.trials.loc[loaded.trials["status"] == "complete", KEYS[:-1]]
    evaluations = loaded.evaluations.merge(complete, on=KEYS[:-1])
    grouped = evaluations.groupby(KEYS, observed=True)
    columns = {"return": "episode_return", "cost": "cost_0"}
    table: dict[str, pd.Series[Any]] = {"episodes": grouped.size()}
    for name, column in columns.items():
        table[name] = grouped[column].mean().round(3)
        table[f"{name}_se"] = grouped[column].sem().round(3)
    table["length"] = grouped["length"].mean().round(1)
    return pd.DataFrame(table).reset_index()


def write_table(description: str | None, table_of: Callable[[Path], pd.DataFrame]) -> None:
    """Print and write the table of the sweep that the command line names."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("sweep", type=Path, help="its folder or an export")
    parser.add_argument("--to", type=Path, required=True)
    arguments = parser.parse_args()
    table = table_of(arguments.sweep)
    print(table.to_string(index=False))
    table.to_csv(arguments.to, index=False, lineterminator="\n")


if __name__ == "__main__":
    write_table(__doc__, final_policies)
