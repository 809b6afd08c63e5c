"""What the last episodes of training cost: a row a trial, over the last tenth of its steps.

python tests/benchmarks/last_episodes.py runs/safety-gym-agents --to results/safety-gym/last-tenth.csv
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from recrl.analysis.data.sweep_data import load_episodes
from recrl.orchestrator.files.sweep_store import SweepStore
from tests.benchmarks.final_policies import write_table

SHARE = 0.1


def last_episodes(sweep: Path) -> pd.DataFrame:
    """Mean cost of the episodes that finished in the last tenth of the steps, with its standard error."""
    episodes = load_episodes(SweepStore(sweep.parent, sweep.name))
    trials = ["task", "agent", "method", "seed"]
    ends = episodes.groupby(trials, observed=True)["end_step"].transform("max")
    last = episodes[episodes["end_step"] > (1.0 - SHARE) * ends]
    costs = last.groupby(trials, observed=True)["cost_0"]
    table = {"episodes": costs.size(), "cost": costs.mean().round(3), "cost_se": costs.sem().round(3)}
    return pd.DataFrame(table).reset_index()


if __name__ == "__main__":
    write_table(__doc__, last_episodes)
