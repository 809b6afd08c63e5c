"""What the policies of further updates cost while they learn, on fresh layouts, and when they are averaged.

    OMP_NUM_THREADS=1 python tests/benchmarks/fresh_costs.py runs/safety-gym-margin --to fresh-costs.csv

Each complete trial goes on from its last checkpoint, for ``--updates`` updates under its limit. Before every
``--every``-th of them the policy that collects the rollouts runs 64 fresh episodes. If agents learnt the
layouts on which they train, and not the task, the fresh episodes would cost more than those of training.
The final policy at that time, which averages the last ones, runs the same 64 episodes.
Only for tasks whose episodes all have the same length.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from recrl.agents.agent import Policy, final_policy
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CurriculumStep
from recrl.environments.registry import make_vector
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.trial.trial import TrialSeeds

FRESH_EPISODES = 64


def fresh_means(policy: Policy, spec: TrialSpec, seed: int) -> tuple[float, float]:
    """Mean return and first cost of fresh episodes."""
    environments = make_vector(spec.task.name, FRESH_EPISODES, options=spec.task.options)
    assert environments.cmdp.horizon is not None
    collector = Collector(environments, num_steps=environments.cmdp.horizon)
    collector.reset(seed=seed)
    rollout, _ = collector.collect(policy, np.random.default_rng(seed))
    return float(rollout.rewards.sum() / FRESH_EPISODES), float(rollout.costs[..., 0].sum() / FRESH_EPISODES)


def continued(trial: TrialStore, updates: int, every: int) -> list[dict[str, Any]]:
    """A row an update; nothing for a trial that is not complete."""
    spec, checkpoint = trial.spec, trial.latest_checkpoint()
    if checkpoint is None or checkpoint["trial"]["update"] < spec.num_updates:
        return []
    tree = checkpoint["trial"]
    environments = make_vector(spec.task.name, spec.num_envs, options=spec.task.options)
    agent = make_agent(spec.agent.name, environments.cmdp, spec.agent.options, TrialSeeds.of(spec).agent)
    agent.load_state_dict(tree["agent"])
    collector = Collector(environments, num_steps=spec.rollout_steps, staggered=True)
    collector.load_state_dict(tree["collector"])
    environments.load_state_dict(tree["environments"])
    generator, rows = np.random.default_rng(0), []
    steps = environments.cmdp.horizon
    assert steps is not None
    for update in range(updates):
        fresh, averaged = [(np.nan, np.nan)] * 2
        if update % every == 0:
            policies = (agent, final_policy(agent))
            fresh, averaged = [fresh_means(policy, spec, 1_000_000 + update) for policy in policies]
        rollout, finished = collector.collect(agent, generator)
        rows.append(
            {
                "task": spec.task.label,
                "seed": spec.seed,
                "limit": spec.deploy_limits.array[0],
                "update": update,
                "training_return": steps * rollout.rewards.mean(),
                "training_cost": steps * rollout.costs[..., 0].mean(),
                "fresh_return": fresh[0],
                "fresh_cost": fresh[1],
                "average_return": averaged[0],
                "average_cost": averaged[1],
            }
        )
        agent.update(rollout, episode_costs(finished, 1), CurriculumStep(spec.deploy_limits))
    return rows


def main() -> None:
    """Go on, print the means, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweep", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    parser.add_argument("--updates", type=int, default=96)
    parser.add_argument("--every", type=int, default=6)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    store = SweepStore(arguments.sweep.parent, arguments.sweep.name)
    rows = [row for trial in store.trials() for row in continued(trial, arguments.updates, arguments.every)]
    table = pd.DataFrame(rows)
    table.round(3).to_csv(arguments.to, index=False, lineterminator="\n")
    kinds = ("training", "fresh", "average")
    columns = [f"{kind}_{value}" for value in ("return", "cost") for kind in kinds]
    print(table.groupby(["task", "limit", "seed"])[columns].mean().round(2).to_string())


if __name__ == "__main__":
    main()
