"""Whether PPO learns what everybody's PPO learns: CartPole-v1 and Pendulum-v1, curves and final policies.

    OMP_NUM_THREADS=1 python tests/benchmarks/standard_tasks.py --folder results/learning

CartPole-v1 counts as solved at a mean return of 475 (Gymnasium's own threshold; 500 is the most there is).
Pendulum-v1 has no threshold; good PPO implementations end at about -200 to -150, and a mean return is never
far above -130, the cost of swinging up. Settings that are not PPO's defaults are in ``CURVES``.

Writes ``ppo.csv`` (a row an update in which an episode finished: task, seed, env_steps, episode_return) and
``ppo.png``, and prints what the frozen policies earn in 100 new episodes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
import torch

from recrl.agents.collection import Collector, episode_costs
from recrl.agents.evaluation import PolicyKind, evaluate
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.registry import make_vector

mpl.use("Agg")
import matplotlib.pyplot as plt


@dataclass(frozen=True)
class Curve:
    """How PPO learns one task, and the return that it should reach."""

    task: str
    expected: float
    total_steps: int
    num_envs: int
    rollout_steps: int
    options: Mapping[str, Any] = field(default_factory=dict)


CURVES = (
    Curve("CartPole-v1", 475.0, 200_000, num_envs=16, rollout_steps=128),
    # As PPO is usually set for this task: only the next half second counts, and updates are thorough. Returns
    # are in the hundreds, so critics that begin near 0 need long steps to get there.
    Curve(
        "Pendulum-v1",
        -200.0,
        250_000,
        num_envs=16,
        rollout_steps=256,
        options={
            "discount": 0.9,
            "minibatch_size": 256,
            "policy_passes": 10,
            "critic_passes": 10,
            "critic_learning_rate": 0.003,
            "target_kl": 0.05,
        },
    ),
)


def learn(curve: Curve, seed: int) -> tuple[pd.DataFrame, dict[str, Any]]:
    """The curve of one seed, a row an update, and what its policies earn once frozen."""
    options = {"id": curve.task, "costless": True}
    environments = make_vector("gymnasium", curve.num_envs, options=options)
    environment_seed, agent_seed, policy_seed, test_seed = np.random.SeedSequence(seed).spawn(4)
    agent = make_agent("ppo", environments.cmdp, curve.options, agent_seed)
    collector = Collector(environments, num_steps=curve.rollout_steps)
    collector.reset(seed=int(environment_seed.generate_state(1)[0]))
    generator = np.random.default_rng(policy_seed)
    steps_per_update = curve.num_envs * curve.rollout_steps
    rows = []
    start = time.process_time()
    for update in range(1, curve.total_steps // steps_per_update + 1):
        rollout, episodes = collector.collect(agent, generator)
        agent.update(rollout, episode_costs(episodes, 1), CurriculumStep(CostLimits.unlimited(1)))
        if episodes:
            earned = float(np.mean([episode.episode_return for episode in episodes]))
            rows.append((curve.task, seed, update * steps_per_update, earned))
    final: dict[str, Any] = {"task": curve.task, "seed": seed, "cpu_seconds": time.process_time() - start}
    for policy in PolicyKind:
        fresh = make_vector("gymnasium", curve.num_envs, options=options)
        episodes = evaluate(agent, fresh, policy, num_episodes=100, seed=test_seed)
        final[str(policy)] = float(np.mean([episode.episode_return for episode in episodes]))
    return pd.DataFrame(rows, columns=["task", "seed", "env_steps", "episode_return"]), final


def draw(rows: pd.DataFrame, path: Path) -> None:
    """All seeds of every task, and the return that is expected."""
    figure, panels = plt.subplots(1, len(CURVES), figsize=(9.0, 3.4), layout="constrained")
    for panel, curve in zip(panels, CURVES, strict=True):
        for index, (seed, run) in enumerate(rows[rows["task"] == curve.task].groupby("seed")):
            panel.plot(run["env_steps"], run["episode_return"], color=f"C{index}", label=f"seed {seed}")
        panel.axhline(curve.expected, color="0.4", linestyle="--", linewidth=1.0)
        panel.annotate(
            f"expected {curve.expected:g}",
            (0.0, curve.expected),
            xytext=(4, -11 if curve.expected > 0 else 4),
            textcoords="offset points",
            color="0.4",
        )
        panel.set(title=curve.task, xlabel="environment steps", ylabel="episode return")
        panel.xaxis.set_major_formatter(mpl.ticker.EngFormatter(sep=""))
    panels[-1].legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=150)


def main() -> None:
    """Learn, write, draw and print."""
    parser = argparse.ArgumentParser(description="PPO on CartPole-v1 and Pendulum-v1.")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--only", nargs="+", default=[], metavar="TASK")
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = []
    for curve in CURVES:
        for seed in arguments.seeds if not arguments.only or curve.task in arguments.only else ():
            rows, final = learn(curve, seed)
            found.append(rows)
            kept = "" if final["stochastic"] >= curve.expected else "  misses"
            print(
                f"{curve.task} seed {seed}: stochastic {final['stochastic']:.1f}, deterministic "
                f"{final['deterministic']:.1f}, {final['cpu_seconds']:.0f} CPU s{kept}",
                flush=True,
            )
    if arguments.folder:
        arguments.folder.mkdir(parents=True, exist_ok=True)
        pd.concat(found).to_csv(arguments.folder / "ppo.csv", index=False, float_format="%.5g")
        draw(pd.concat(found), arguments.folder / "ppo.png")


if __name__ == "__main__":
    main()
