"""Is an agent's estimate of the mean episode cost right? It is compared with the episodes that finished.

Over the second half of the steps, a row a trial: mean and standard deviation of the estimates that the agent
made at each update, and the mean cost of the episodes that finished meanwhile.

python -m tests.benchmarks.cost_estimates runs/velocity --to results/velocity/estimates.csv
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from recrl.analysis.data.sweep_data import load
from recrl.orchestrator.files.sweep_store import SweepStore
from tests.benchmarks.final_policies import write_table

KEYS = ["task", "agent", "method", "seed"]


def cost_estimates(sweep: Path) -> pd.DataFrame:
    """One row a trial."""
    updates = load(SweepStore(sweep.parent, sweep.name)).updates
    last_steps = updates.groupby(KEYS, observed=True).end_step.transform("max")
    late = updates[updates.end_step > last_steps / 2]
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


if __name__ == "__main__":
    write_table(__doc__, cost_estimates)
