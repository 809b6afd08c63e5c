"""What fewer passes of the critics cost: how well they tell the next rollout, and what the agent learns.

    OMP_NUM_THREADS=1 python tests/benchmarks/critic_passes.py --folder results/learning

An update's time is mostly its critics' where rollouts are large and no observation comes twice; where
observations repeat, or rollouts are small, ``critic_passes`` changes nothing. Here rollouts have 20,000
steps, as in ``bench_end_to_end.py``. The share of the variance of the value targets that the critics
explain is measured on rollouts that they have not seen yet: that is what advantages are estimated with.

Writes ``passes.csv`` (a row an update: passes, metric_samples, seed, env_steps, episode_return, cost,
explained_reward, explained_cost, update_cpu_seconds) and prints means over the last half of the updates.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from recrl.agents.agent import Rollout
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.learning.actor_critic import ActorCritic
from recrl.agents.learning.learning_batch import LearningBatch
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep, Floats
from recrl.environments.registry import make_vector

NUM_ENVS, NUM_STEPS = 20, 1000
STEP = CurriculumStep(CostLimits((25.0,)))
COLUMNS = [
    "agent",
    "passes",
    "metric_samples",
    "seed",
    "env_steps",
    "episode_return",
    "cost",
    "explained_reward",
    "explained_cost",
    "update_cpu_seconds",
]


def explained(agent: ActorCritic, rollout: Rollout) -> Floats:
    """The share of the variance of the targets that the critics explain, of the reward and each cost."""
    observations = rollout.observations.reshape(-1, rollout.observations.shape[-1])
    actions = rollout.actions.reshape(len(observations), *rollout.actions.shape[2:])
    batch = LearningBatch.deduplicate(observations, actions, compact=False)
    found = agent._estimate(rollout, rollout.costs, batch)
    share: Floats = 1.0 - found.advantages.var(axis=0) / found.targets.var(axis=0)
    return share


def learn(agent_name: str, task: str, passes: int, *, samples: int, seed: int, updates: int) -> pd.DataFrame:
    """A row an update."""
    environment_seed, agent_seed, policy_seed = np.random.SeedSequence(seed).spawn(3)
    environments = make_vector(task, NUM_ENVS)
    options = {"critic_passes": passes} | ({"metric_samples": samples} if agent_name == "cpo" else {})
    agent = make_agent(agent_name, environments.cmdp, options, agent_seed)
    assert isinstance(agent, ActorCritic)
    collector = Collector(environments, num_steps=NUM_STEPS)
    collector.reset(seed=int(environment_seed.generate_state(1)[0]))
    generator = np.random.default_rng(policy_seed)
    rows = []
    for update in range(1, updates + 1):
        rollout, episodes = collector.collect(agent, generator)
        told = explained(agent, rollout)
        costs = episode_costs(episodes, 1)
        before = time.process_time()
        agent.update(rollout, costs, STEP)
        seconds = time.process_time() - before
        earned = float(np.mean([episode.episode_return for episode in episodes]))
        steps = update * NUM_ENVS * NUM_STEPS
        rows.append((agent_name, passes, samples, seed, steps, earned, float(costs.mean()), *told, seconds))
    return pd.DataFrame(rows, columns=COLUMNS)


def main() -> None:
    """Learn, write and print."""
    parser = argparse.ArgumentParser(description="What fewer passes of the critics cost.")
    parser.add_argument("--task", default="PointGoal1")
    parser.add_argument("--agents", nargs="+", default=["cpo"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--passes", nargs="+", type=int, default=[5, 4, 3])
    parser.add_argument("--metric-samples", type=int, default=2048)
    parser.add_argument("--updates", type=int, default=30)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = []
    for agent_name in arguments.agents:
        for seed in arguments.seeds:
            for passes in arguments.passes:
                found.append(
                    learn(
                        agent_name,
                        arguments.task,
                        passes,
                        samples=arguments.metric_samples,
                        seed=seed,
                        updates=arguments.updates,
                    )
                )
                means = found[-1].tail(arguments.updates // 2).mean(numeric_only=True)
                print(
                    f"{agent_name} {arguments.task} passes {passes} seed {seed}: return "
                    f"{means['episode_return']:.2f}, cost {means['cost']:.1f}, explained "
                    f"{means['explained_reward']:.3f} / {means['explained_cost']:.3f}, update "
                    f"{means['update_cpu_seconds']:.2f} s",
                    flush=True,
                )
    if arguments.folder:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        pd.concat(found).to_csv(arguments.folder / "passes.csv", index=False, float_format="%.5g")


if __name__ == "__main__":
    main()
