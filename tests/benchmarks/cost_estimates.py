"""Is an agent's estimate of the mean episode cost right? It is compared with the episodes that finished.

Over the second half of the steps, a row a trial: mean and standard deviation of the estimates that the agent
made at each update, and the mean cost of the episodes that finished meanwhile.

python tests/benchmarks/cost_estimates.py runs/velocity --to results/velocity/estimates.csv
"""

from __future__ import annotations

import argparse
from pathlib import Path

import pandas as pd

from recrl.analysis.data.sweep_data import load
from recrl.orchestrator.files.sweep_store import SweepStore

KEYS = ["task", "agent", "method", "seed"]


def cost_estimates(sweep: Path) -> pd.DataFrame:
    """One row a trial."""
    data = load(SweepStore(sweep.parent, sweep.name))
    late = data.updates[
        data.updates.end_step > data.updates.groupby(KEYS, observed=True).end_step.transform("max") / 2
    ]
    late = late.assign(estimate=late.cost_gap_0 + late.limit_0, sum_of_costs=late.episodes * late.cost_0)
    trials = late.groupby(KEYS, observed=True)
    columns = {
        "updates": trials.size(),
        "estimate": trials.estimate.mean().round(2),
        "estimate_sd": trials.estimate.std().round(2),
        "episodes": trials.episodes.sum(),
        "episode_cost": (trials.sum_of_costs.sum() / trials.episodes.sum()).round(2),
    }
    return pd.DataFrame(columns).reset_index()


def main() -> None:
    """Read, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweep", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    arguments = parser.parse_args()
    table = cost_estimates(arguments.sweep)
    print(table.to_string(index=False))
    table.to_csv(arguments.to, index=False, lineterminator="\n")


if __name__ == "__main__":
    main()
