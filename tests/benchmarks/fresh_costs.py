"""What the policies of further updates cost while they learn, on fresh layouts, and when they are averaged.

    export OMP_NUM_THREADS=1
    python tests/benchmarks/fresh_costs.py runs/safety-gym-margin-control --to fresh-costs.csv

Each complete trial goes on from its last checkpoint, for ``--updates`` updates under its limit. Before every
``--every``-th of them the policy that collects the rollouts runs 64 fresh episodes. If agents learnt the
layouts on which they train, and not the task, the fresh episodes would cost more than those of training.
With ``--decays`` moving averages of the policies run the same episodes, once they are 16 updates old. With
``--last-statistics`` their observations are standardised by the statistics of the last update, as they were
before commit 2c6c6a8.
All values are sums over as many steps as the longest episode has.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from recrl.agents.agent import Policy
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.learning.actor_critic import ActorCritic
from recrl.agents.learning.final_policy import NetworkPolicy, PolicyAverage
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CurriculumStep
from recrl.environments.registry import make_vector
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.files.trial_store import TrialStore
from recrl.orchestrator.spec import TrialSpec
from recrl.orchestrator.trial.trial import TrialSeeds

FRESH_EPISODES = 64
LEAST_AGE = 16  # updates before an average is evaluated


def fresh_means(policy: Policy, spec: TrialSpec, seed: int) -> tuple[float, float]:
    """Mean return and first cost of fresh episodes, or of more than one where they end early."""
    environments = make_vector(spec.task.name, FRESH_EPISODES, options=spec.task.options)
    assert environments.cmdp.horizon is not None
    collector = Collector(environments, num_steps=environments.cmdp.horizon)
    collector.reset(seed=seed)
    rollout, _ = collector.collect(policy, np.random.default_rng(seed))
    return float(rollout.rewards.sum() / FRESH_EPISODES), float(rollout.costs[..., 0].sum() / FRESH_EPISODES)


def continued(
    trial: TrialStore, updates: int, every: int, decays: Sequence[float], *, last_statistics: bool
) -> list[dict[str, Any]]:
    """A row an update; nothing for a trial that is not complete."""
    spec, checkpoint = trial.spec, trial.latest_checkpoint()
    if checkpoint is None or checkpoint["trial"]["update"] < spec.num_updates:
        return []
    tree = checkpoint["trial"]
    environments = make_vector(spec.task.name, spec.num_envs, options=spec.task.options)
    agent, spare = (
        make_agent(spec.agent.name, environments.cmdp, spec.agent.options, TrialSeeds.of(spec).agent)
        for _ in range(2)
    )
    assert isinstance(agent, ActorCritic)
    assert isinstance(spare, ActorCritic)
    agent.load_state_dict(tree["agent"])
    averages = {decay: PolicyAverage(spare._network, decay) for decay in decays}
    collector = Collector(environments, num_steps=spec.rollout_steps, staggered=True)
    collector.load_state_dict(tree["collector"])
    environments.load_state_dict(tree["environments"])
    generator, rows = np.random.default_rng(0), []
    steps = environments.cmdp.horizon
    assert steps is not None
    for update in range(updates):
        seed, is_due = 1_000_000 + update, update % every == 0
        fresh = fresh_means(agent, spec, seed) if is_due else (np.nan, np.nan)
        averaged = {}
        for decay, average in averages.items():
            if is_due and update >= LEAST_AGE:
                encoder = agent._encoder
                if not last_statistics:
                    encoder = encoder.with_statistics(average.statistics)
                policy = NetworkPolicy(encoder, average.network())
                averaged[f"average_{decay}_return"], averaged[f"average_{decay}_cost"] = fresh_means(
                    policy, spec, seed
                )
        rollout, finished = collector.collect(agent, generator)
        rows.append(
            {
                "task": spec.task.label,
                "agent": spec.agent.label,
                "seed": spec.seed,
                "limit": spec.deploy_limits.array[0],
                "update": update,
                "training_return": steps * rollout.rewards.mean(),
                "training_cost": steps * rollout.costs[..., 0].mean(),
                "fresh_return": fresh[0],
                "fresh_cost": fresh[1],
                **averaged,
            }
        )
        agent.update(rollout, episode_costs(finished, 1), CurriculumStep(spec.deploy_limits))
        for average in averages.values():
            average.add(agent._network.parameters.to_numpy(), agent._encoder.statistics)
    return rows


def main() -> None:
    """Go on, print the means, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sweep", type=Path)
    parser.add_argument("--to", type=Path, required=True)
    parser.add_argument("--updates", type=int, default=96)
    parser.add_argument("--every", type=int, default=6)
    parser.add_argument("--decays", type=float, nargs="*", default=[])
    parser.add_argument("--last-statistics", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    store = SweepStore(arguments.sweep.parent, arguments.sweep.name)
    rows = [
        row
        for trial in store.trials()
        for row in continued(
            trial,
            arguments.updates,
            arguments.every,
            arguments.decays,
            last_statistics=arguments.last_statistics,
        )
    ]
    table = pd.DataFrame(rows)
    table.round(3).to_csv(arguments.to, index=False, lineterminator="\n")
    columns = [name for end in ("return", "cost") for name in table if str(name).endswith(f"_{end}")]
    print(table.groupby(["task", "agent", "limit", "seed"])[columns].mean().round(2).to_string())


if __name__ == "__main__":
    main()
