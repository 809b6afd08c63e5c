"""A million random steps of the Safety Gym tasks: nothing may become NaN or infinite.

python tests/benchmarks/safety_soak.py [--steps 1000000] [--tasks CarGoal2 CarButton2 CarPush2]

The steps are shared among the tasks. Half of the environments hold each action for 25 steps, and so meet more
obstacles. Broken physics would show as an episode that ended with ``cost_exception``; it is counted.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from recrl.environments.safety_gym.safety_gym_environments import SafetyGymVectorEnv

NUM_ENVS = 64
HELD_STEPS = 25


def soak(task: str, steps: int) -> tuple[int, int]:
    """Steps taken and episodes whose physics broke down; raises if anything is not finite."""
    environment, generator = SafetyGymVectorEnv(task, NUM_ENVS, cost="per_hazard"), np.random.default_rng(1)
    observations, _ = environment.reset(seed=1)
    broken, taken = 0, 0
    actions = np.zeros((NUM_ENVS, 2))
    while taken < steps:
        drawn = generator.uniform(-1.0, 1.0, (NUM_ENVS, 2))
        held = NUM_ENVS if (taken // NUM_ENVS) % HELD_STEPS == 0 else NUM_ENVS // 2
        actions[:held] = drawn[:held]
        observations, rewards, _, _, info = environment.step(actions)
        if not (
            np.isfinite(observations).all() and np.isfinite(rewards).all() and np.isfinite(info["cost"]).all()
        ):
            raise FloatingPointError(f"{task}: a number is not finite after {taken} steps")
        broken += int(np.sum(info.get("cost_exception", 0.0)))
        taken += NUM_ENVS
    return taken, broken


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--tasks", nargs="+", default=["CarGoal2", "CarButton2", "CarPush2"])
    arguments = parser.parse_args()
    for task in arguments.tasks:
        taken, broken = soak(task, arguments.steps // len(arguments.tasks))
        print(f"{task}: {taken:,} steps, all finite; physics broke down in {broken} episodes", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
