"""What final policies earn if an episode stops when its cost has reached a limit, as it does for some agents.

    OMP_NUM_THREADS=1 python -m tests.benchmarks.stopped_episodes runs/safety-gym-margin-half --to stopped.csv

OmniSafe's evaluator stops the episodes of its early-terminated agents when their cost is at least the limit.
So their published results are returns until then. Here the same is done to policies that learnt in whole
episodes. Each runs ``--episodes`` episodes at the same time, on fresh layouts; the same episodes give the
returns and costs with the stop and without it. Tasks that end early are refused.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from recrl.agents.collection import Collector
from recrl.agents.evaluation import EvaluatedPolicy, PolicyKind
from recrl.environments.registry import make_vector
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.trial.saved_policy import SavedTrial


def outcomes(
    trial: SavedTrial, policy: PolicyKind, *, limit: float, number: int, seed: int
) -> dict[str, Any]:
    """Mean returns and first costs of the same episodes, with and without the stop."""
    task = trial.spec.task
    environments = make_vector(task.name, number, options=task.options)
    horizon = environments.cmdp.horizon
    assert horizon is not None
    collector = Collector(environments, num_steps=horizon)
    collector.reset(seed=seed)
    rollout, finished = collector.collect(EvaluatedPolicy(trial.policy, policy), np.random.default_rng(seed))
    if [episode.length for episode in finished] != [horizon] * number:
        raise SystemExit(f"{task.name}: an episode did not last {horizon} steps")
    costs = rollout.costs[..., 0]
    counted = np.cumsum(costs, axis=0) - costs < limit
    stopped_returns, stopped_costs = (rollout.rewards * counted).sum(axis=0), (costs * counted).sum(axis=0)
    values = {
        "return": rollout.rewards.sum(axis=0),
        "cost": costs.sum(axis=0),
        "stopped_return": stopped_returns,
        "stopped_cost": stopped_costs,
        "stopped_length": counted.sum(axis=0),
    }
    row: dict[str, Any] = {name: float(value.mean()) for name, value in values.items()}
    return row | {"stopped_return_se": float(stopped_returns.std(ddof=1) / np.sqrt(number))}


def rows_of(sweep: Path, *, limit: float, number: int, seed: int) -> Iterator[dict[str, Any]]:
    """A row a trial with a checkpoint and a kind of policy."""
    for store in SweepStore(sweep.parent, sweep.name).trials():
        trial = SavedTrial.load(store)
        spec = trial.spec
        keys = {
            "task": spec.task.name,
            "agent": spec.agent.label,
            "seed": spec.seed,
            "steps": trial.env_steps,
        }
        for policy in PolicyKind:
            yield (
                keys
                | {"policy": policy.value}
                | outcomes(trial, policy, limit=limit, number=number, seed=seed)
            )


def main() -> None:
    """Write and print the table of some sweeps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("sweeps", nargs="+", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    parser.add_argument("--limit", type=float, default=25.0)
    parser.add_argument("--episodes", type=int, default=128)
    parser.add_argument("--seed", type=int, default=20261127)
    given = parser.parse_args()
    torch.set_num_threads(1)
    table = pd.DataFrame(
        row
        for sweep in given.sweeps
        for row in rows_of(sweep, limit=given.limit, number=given.episodes, seed=given.seed)
    )
    table.round(3).to_csv(given.to, index=False, lineterminator="\n")
    print(table.groupby(["task", "agent", "policy"]).mean(numeric_only=True).round(2).to_string())


if __name__ == "__main__":
    main()
