"""Do the discounted and the undiscounted return of a training run rise together?

A row a trial and 100,000 steps, over the episodes that finished in them: mean length, return and cost, and
the mean discounted return of all their steps. Only the sum of an episode's rewards is recorded, so they are
taken to be the same, r, in each of its L steps. With n steps left, 1 to L, the discounted return is then
r (1 - g^n) / (1 - g).

python -m tests.benchmarks.discounted_returns runs/velocity --to results/velocity/discounted-returns.csv
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from recrl.environments.cmdp import Floats
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_reader import TrialReader
from tests.benchmarks.final_policies import write_table

DISCOUNTS = (0.99, 0.995)
STEPS = 100_000


def mean_discounted_return(lengths: Floats, returns: Floats, discount: float) -> float:
    """Return the mean discounted return over all steps of E episodes with lengths [E] and returns [E]."""
    rewards = returns / lengths
    powers = discount * (1 - discount**lengths) / (1 - discount)  # sum of g^n, n = 1 to L
    sums = rewards * (lengths - powers) / (1 - discount)
    return float(sums.sum() / lengths.sum())


def discounted_returns(sweep: Path) -> pd.DataFrame:
    """Return the rows of all trials, complete or not."""
    trials = SweepStore(sweep.parent, sweep.name).trials()
    return pd.DataFrame([row for trial in trials for row in _rows(trial)])


def _rows(trial: TrialReader) -> Iterator[dict[str, Any]]:
    spec, episodes = trial.spec, trial.episodes()
    for interval, part in episodes.groupby((episodes.end_step - 1) // STEPS):
        lengths, returns = part.length.to_numpy(float), part.episode_return.to_numpy()
        yield {
            "task": spec.task.label,
            "agent": spec.agent.label,
            "method": spec.method.label,
            "seed": spec.seed,
            "to_step": STEPS * (interval + 1),
            "episodes": len(part),
            "length": round(lengths.mean(), 1),
            "return": round(returns.mean(), 1),
            "cost": round(part.cost_0.mean(), 1),
            **{f"discounted_{g}": round(mean_discounted_return(lengths, returns, g), 1) for g in DISCOUNTS},
        }


if __name__ == "__main__":
    write_table(__doc__, discounted_returns)
