"""What a step of the fast environments costs, and what J*(d) costs: CPU time, one core.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_environments.py

The aim for RiverGrid is at most 25 us a step of 16 environments.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from recrl.environments.cmdp import CostLimits
from recrl.environments.finite.exact_solver import solve_by_lagrangian
from recrl.environments.registry import make_vector
from recrl.environments.rivergrid.grid_world import RiverGridVectorEnv
from recrl.environments.rivergrid.minigrid_env import RiverGridEnv

STEPS = 20_000
REPEATS = 5


def best_microseconds(work: Callable[[], Any], calls: int) -> float:
    """The smallest CPU time per call of several repeats, in microseconds."""
    times = []
    for _ in range(REPEATS):
        before = time.process_time()
        work()
        times.append((time.process_time() - before) / calls * 1e6)
    return min(times)


def vector_step(name: str, num_envs: int, options: dict[str, Any]) -> float:
    environment = make_vector(name, num_envs, options=options)
    environment.reset(seed=0)
    environment.action_space.seed(0)
    actions = [environment.action_space.sample() for _ in range(STEPS)]

    def work() -> None:
        for action in actions:
            environment.step(action)

    return best_microseconds(work, STEPS)


def minigrid_step() -> float:
    environment = RiverGridEnv("rivergrid-1a")
    environment.reset(seed=0)
    actions = np.random.default_rng(0).integers(3, size=STEPS // 10).tolist()

    def work() -> None:
        for action in actions:
            _, _, terminated, truncated, _ = environment.step(action)
            if terminated or truncated:
                environment.reset()

    return best_microseconds(work, len(actions))


def main() -> None:
    print(f"{'task':<22}{'B':>4}{'us/step call':>15}{'us/env step':>14}")
    rows: list[tuple[str, int, dict[str, Any]]] = [
        ("rivergrid-1a", 1, {}),
        ("rivergrid-1a", 16, {}),
        ("rivergrid-1a", 64, {}),
        ("two-state", 16, {}),
        ("two-state", 16, {"arrival": 0.5}),
        ("continuous-bandit", 16, {}),
        ("gymnasium", 16, {"id": "CartPole-v1", "costless": True}),
    ]
    for name, num_envs, options in rows:
        cost = vector_step(name, num_envs, options)
        print(f"{name:<22}{num_envs:>4}{cost:>15.1f}{cost / num_envs:>14.2f}")
    cost = minigrid_step()
    print(f"{'RiverGrid on MiniGrid':<22}{1:>4}{cost:>15.1f}{cost:>14.2f}")
    for name in ("rivergrid-1a", "rivergrid-1b"):
        environment = make_vector(name, 1)
        assert isinstance(environment, RiverGridVectorEnv)
        model = environment.finite_cmdp()
        cost = best_microseconds(partial(solve_by_lagrangian, model, CostLimits((1.0,))), 1)
        print(f"J*(1) of {name}: {cost / 1e3:.0f} ms")


if __name__ == "__main__":
    main()
