"""The presets ``recommended`` and ``paper`` on one task, side by side: exact return and cost.

    OMP_NUM_THREADS=1 python tests/benchmarks/preset_curves.py --folder results/learning

The task is the two-state CMDP of ``learning.py``, of which the optimum J*(d) is known. It shows that both
learn, and what an update of each costs, not which is better.

Writes ``presets.csv`` (a row an update: agent, preset, seed, env_steps, episode_return, cost) and
``presets.png``.
"""

from __future__ import annotations

import argparse
import runpy
import time
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pandas as pd
import torch

from recrl.agents.collection import Collector, episode_costs
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.registry import make_vector

mpl.use("Agg")
import matplotlib.pyplot as plt

LEARNING = runpy.run_path(str(Path(__file__).parent / "learning.py"))
TASK = "two-state"
AGENT_NAMES = ("ppo-lag", "cpo")
PRESETS = ("recommended", "paper")


def learn(agent_name: str, preset: str, seed: int, updates: int) -> pd.DataFrame:
    """The exact value of the policy after each update, and the CPU seconds of all updates so far."""
    exercise = LEARNING["EXERCISES"][TASK]
    environment_seed, agent_seed, policy_seed = np.random.SeedSequence(seed).spawn(3)
    environments = make_vector(exercise.task, exercise.num_envs, options=exercise.options)
    agent = make_agent(agent_name, environments.cmdp, {"preset": preset}, agent_seed)
    collector = Collector(environments, num_steps=exercise.num_steps)
    collector.reset(seed=int(environment_seed.generate_state(1)[0]))
    generator = np.random.default_rng(policy_seed)
    rows, seconds = [], 0.0
    for update in range(1, updates + 1):
        rollout, episodes = collector.collect(agent, generator)
        before = time.process_time()
        agent.update(rollout, episode_costs(episodes, 1), CurriculumStep(CostLimits(exercise.limits)))
        seconds += time.process_time() - before
        value = LEARNING["true_value"](agent, environments)
        steps = update * environments.num_envs * exercise.num_steps
        rows.append((agent_name, preset, seed, steps, value.episode_return, value.costs[0], seconds))
    columns = ["agent", "preset", "seed", "env_steps", "episode_return", "cost", "update_cpu_seconds"]
    return pd.DataFrame(rows, columns=columns)


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Return and cost against environment steps: a line a seed, a colour a preset, a row an agent."""
    exercise = LEARNING["EXERCISES"][TASK]
    figure, panels = plt.subplots(
        len(AGENT_NAMES), 2, figsize=(9.0, 5.6), sharex=True, layout="constrained", squeeze=False
    )
    for agent_name, line in zip(AGENT_NAMES, panels, strict=True):
        for preset, colour in zip(PRESETS, ("C0", "C1"), strict=True):
            runs = rows[(rows["agent"] == agent_name) & (rows["preset"] == preset)]
            per_update = 1e3 * runs.groupby("seed")["update_cpu_seconds"].max().sum() / len(runs)
            label = f"{preset} ({per_update:.0f} ms an update)"
            for _, run in runs.groupby("seed"):
                line[0].plot(run["env_steps"], run["episode_return"], color=colour, label=label, linewidth=1)
                line[1].plot(run["env_steps"], run["cost"], color=colour, linewidth=1)
                label = "_"
        for panel, level, name in ((line[0], exercise.optimum, "J*(d)"), (line[1], exercise.limits[0], "d")):
            panel.axhline(level, color="0.4", linestyle="--", linewidth=1)
            panel.annotate(
                name,
                (1.0, level),
                xycoords=("axes fraction", "data"),
                xytext=(4, -3),
                textcoords="offset points",
                color="0.4",
                annotation_clip=False,
            )
        line[0].set(ylabel="return", title=agent_name)
        line[1].set(ylabel="cost", title=agent_name)
        line[0].legend(frameon=False, loc="lower right")
    for panel in panels[-1]:
        panel.set_xlabel("environment steps")
        panel.xaxis.set_major_formatter(mpl.ticker.EngFormatter(sep=""))
    figure.savefig(path, dpi=150)


def main() -> None:
    """Learn, write, draw and print."""
    parser = argparse.ArgumentParser(description="The presets recommended and paper on one task.")
    parser.add_argument("--seeds", nargs="+", type=int, default=[10, 11])
    parser.add_argument("--updates", type=int, default=60)
    parser.add_argument("--folder", type=Path, required=True)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = pd.concat(
        [
            learn(agent_name, preset, seed, arguments.updates)
            for agent_name in AGENT_NAMES
            for preset in PRESETS
            for seed in arguments.seeds
        ]
    )
    arguments.folder.mkdir(parents=True, exist_ok=True)
    rows.to_csv(arguments.folder / "presets.csv", index=False, float_format="%.5g")
    draw(rows, arguments.folder / "presets.png")
    last = rows.groupby(["agent", "preset", "seed"]).last()
    print(last.to_string(float_format=lambda value: f"{value:.3f}"))


if __name__ == "__main__":
    main()
