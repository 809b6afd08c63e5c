"""Wall time of an update on CUDA and on one thread of a CPU, and whether agents learn the same on both.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_cuda.py [--updates 8]
    OMP_NUM_THREADS=1 python tests/benchmarks/bench_cuda.py --device cuda --seeds 106 107 108 --steps 500000

The first form prints the wall milliseconds of 4,096 steps and of the learning from them. Both agents advance
in turns; the ratio is the median over the pairs. The second runs whole trials of ``ppo-lag`` on PointGoal2,
each in a process of its own, and prints their final policies.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import tempfile
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from recrl.agents.collection import Collector, episode_costs
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.registry import make_vector
from recrl.orchestrator.files.sweep_store import SweepStore
from recrl.orchestrator.spec import Choice, TrialSpec
from recrl.orchestrator.trial.attempt import run_recorded

TASKS = ("CarGoal2", "SafetyHumanoidVelocity")
AGENTS = ("ppo-lag", "cpo")
SIZES = (64, 256, 1024)
LIMIT, NUM_ENVS, ROLLOUT_STEPS = 25.0, 64, 64


class Trial:
    """An agent on a device and its task, advanced update by update."""

    def __init__(self, device: str, task: str, agent: str, units: int) -> None:
        environments = make_vector(task, NUM_ENVS)
        with torch.device(device):
            options = {"hidden_sizes": [units, units]}
            self.agent = make_agent(agent, environments.cmdp, options, np.random.SeedSequence(0))
        self.collector = Collector(environments, num_steps=ROLLOUT_STEPS)
        self.collector.reset(seed=0)
        self.generator = np.random.default_rng(0)

    def update(self) -> tuple[float, float]:
        """Wall seconds of 4,096 steps, and of learning from them."""
        start = time.perf_counter()
        rollout, episodes = self.collector.collect(self.agent, self.generator)
        collected = time.perf_counter()
        step = CurriculumStep(CostLimits((LIMIT,)))
        self.agent.update(rollout, episode_costs(episodes, 1), step)  # its metrics wait for the device
        return collected - start, time.perf_counter() - collected


def compared(updates: int) -> None:
    """Print a row a task, agent and size."""
    print("task                    agent    units  steps, CPU  steps, CUDA  learning, CPU  CUDA  CPU / CUDA")
    for task, agent, units in itertools.product(TASKS, AGENTS, SIZES):
        trials = [Trial(device, task, agent, units) for device in ("cpu", "cuda")]
        for trial in trials:
            trial.update()  # compiles and warms up
        times = 1e3 * np.array([[trial.update() for trial in trials] for _ in range(updates)])
        ratio = np.median(times[:, 0].sum(1) / times[:, 1].sum(1))
        (steps_cpu, learn_cpu), (steps_cuda, learn_cuda) = np.median(times, axis=0)
        print(
            f"{task:23} {agent:8} {units:5}  {steps_cpu:10.0f}  {steps_cuda:11.0f}"
            f"  {learn_cpu:13.0f} {learn_cuda:5.0f}  {ratio:10.2f}",
            flush=True,
        )


def final_policy(device: str, seed: int, steps: int) -> pd.DataFrame:
    """The evaluated episodes of a whole trial on a device, and its wall seconds."""
    torch.set_num_threads(1)
    deployed = round(0.05 * steps / (NUM_ENVS * ROLLOUT_STEPS)) * NUM_ENVS * ROLLOUT_STEPS
    spec = TrialSpec(
        task=Choice("PointGoal2"),
        agent=Choice("ppo-lag"),
        method=Choice("none"),
        train_limits=CostLimits((LIMIT,)),
        deploy_limits=CostLimits((LIMIT,)),
        train_steps=steps - deployed,
        deploy_steps=deployed,
        num_envs=NUM_ENVS,
        rollout_steps=ROLLOUT_STEPS,
        evaluation_episodes=128,
        seed=seed,
    )
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        trial = SweepStore(Path(folder), "cuda").trial(spec)
        run_recorded(spec, trial, should_stop=lambda: False, on_gpu=device == "cuda")
        return pd.read_csv(trial.evaluation_path).assign(
            device=device, seed=seed, seconds=time.perf_counter() - start
        )


def learnt(device: str, seeds: list[int], steps: int) -> None:
    """Print the final policies of one trial a seed."""
    spawn = multiprocessing.get_context("spawn")  # CUDA does not survive a fork
    with closing(spawn.Pool(len(seeds))) as pool:
        episodes = pd.concat(pool.starmap(final_policy, [(device, seed, steps) for seed in seeds]))
    values = episodes.groupby(["policy", "device", "seed"])[["episode_return", "cost_0", "seconds"]].mean()
    print(values.round(2).to_string(), flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--updates", type=int, default=8)
    parser.add_argument("--device", help="runs whole trials on it: cpu or cuda")
    parser.add_argument("--seeds", type=int, nargs="+", default=[106, 107, 108])
    parser.add_argument("--steps", type=int, default=1_000_000)
    arguments = parser.parse_args()
    print(f"torch {torch.__version__}, {os.cpu_count()} cores")
    if torch.cuda.is_available():
        print(torch.cuda.get_device_name())
    torch.set_num_threads(1)
    if arguments.device:
        learnt(arguments.device, arguments.seeds, arguments.steps)
    else:
        compared(arguments.updates)


if __name__ == "__main__":
    main()
