"""What a policy update costs on RiverGrid, beside the arithmetic it cannot do without: CPU time, one core.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_update.py

The aim is at most 60 ms to collect 200 steps of 16 environments and learn from them. The bound is the time
of the matrix products of the networks alone, at the rate that this machine reaches on a large product:
with networks this small, the rest is the number of calls.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from recrl.agents.batch import distinct_rows
from recrl.agents.collect import Collector, episode_costs
from recrl.agents.registry import make_agent
from recrl.environments.registry import make_vector

NUM_ENVS, NUM_STEPS, UPDATES = 16, 200, 30
LIMITS = np.array([5.0])
OPTIONS: list[dict[str, Any]] = [{}, {"compaction": False}]


def milliseconds(work: Callable[[], object]) -> float:
    """The CPU time of one call, in milliseconds."""
    before = time.thread_time()
    work()
    return (time.thread_time() - before) * 1e3


def measure(agent_name: str, options: dict[str, Any]) -> tuple[list[float], list[float], float, int]:
    """Collecting and updating, each a list of milliseconds; mean policy steps; most distinct rows."""
    environments = make_vector("rivergrid-1a", NUM_ENVS)
    agent = make_agent(agent_name, environments.cmdp, options, np.random.SeedSequence(0))
    collector = Collector(environments, num_steps=NUM_STEPS)
    collector.reset(seed=0)
    generator = np.random.default_rng(0)
    collecting, updating, steps, rows = [], [], [], 0
    for _ in range(UPDATES):
        before = time.thread_time()
        rollout, episodes = collector.collect(agent, generator)
        middle = time.thread_time()
        metrics = agent.update(rollout, episode_costs(episodes, 1), LIMITS)
        collecting.append((middle - before) * 1e3)
        updating.append((time.thread_time() - middle) * 1e3)
        steps.append(metrics["policy_steps"])
        found = distinct_rows(rollout.observations.reshape(NUM_ENVS * NUM_STEPS, -1))
        rows = max(rows, NUM_ENVS * NUM_STEPS if found is None else len(found[0]))
    return collecting, updating, float(np.mean(steps)), rows


def flops_a_millisecond() -> float:
    """Floating-point operations a millisecond in a product of two 1024 x 1024 matrices."""
    matrix = torch.ones(1024, 1024)
    return 2.0 * 1024**3 / min(milliseconds(lambda: matrix @ matrix) for _ in range(10))


def pass_flops(rows: int, sizes: tuple[int, ...]) -> float:
    """Of one forward and backward sweep of a network: three products a layer."""
    return sum(6.0 * rows * inputs * outputs for inputs, outputs in pairwise(sizes))


def main() -> None:
    torch.set_num_threads(1)
    rate = flops_a_millisecond()
    print(
        f"{'student':<10}{'options':<24}{'collect ms':>12}{'update ms':>12}"
        f"{'policy steps':>14}{'bound ms':>10}"
    )
    for agent_name in ("ppo-lag", "cpo"):
        for options in OPTIONS:
            collecting, updating, policy_steps, rows = measure(agent_name, options)
            used = NUM_ENVS * NUM_STEPS if options else rows
            critic_sweeps, sweeps_a_direction = 40 * 2, 11 * 2
            policy_sweeps = policy_steps if agent_name == "ppo-lag" else sweeps_a_direction
            flops = critic_sweeps * pass_flops(used, (22, 64, 64, 1))
            flops += policy_sweeps * pass_flops(used, (22, 64, 64, 3))
            print(
                f"{agent_name:<10}{options or '(recommended)'!s:<24}{np.median(collecting):>12.1f}"
                f"{np.median(updating):>12.1f}{policy_steps:>14.1f}{flops / rate:>10.1f}"
            )


if __name__ == "__main__":
    main()
