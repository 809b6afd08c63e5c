"""How close every student comes to the known constrained optimum, over five seeds.

    OMP_NUM_THREADS=1 python tests/benchmarks/learning.py [student ...]

The lessons are those of ``tests/test_learning.py``. A row is one student on one task: the worst and the mean
regret J*(d) - return over the seeds, the worst excess of a cost over its limit, in units of an episode, and
the CPU seconds of one run. The promise is a regret of at most 0.1 and an excess of at most 0.05.
"""

from __future__ import annotations

import runpy
import sys
import time
from pathlib import Path

import numpy as np
import torch

from recrl.environments.cmdp import CostLimits
from recrl.environments.registry import optimal_return

SEEDS = range(5)
LARGEST_REGRET, LARGEST_EXCESS = 0.1, 0.05


def main(agents: list[str]) -> None:
    """Print the table of some students, or of all."""
    torch.set_num_threads(1)
    learning = runpy.run_path(str(Path(__file__).parents[1] / "test_learning.py"))
    print(f"{'student':10}{'task':20}{'worst regret':>14}{'mean':>8}{'worst excess':>14}{'CPU s':>8}")
    for lesson in learning["LESSONS"]:
        if agents and lesson.agent not in agents:
            continue
        optimum = optimal_return(lesson.task, {}, CostLimits(lesson.limits))
        assert optimum is not None
        start = time.process_time()
        runs = [learning["last_quarter"](lesson, seed) for seed in SEEDS]
        seconds = (time.process_time() - start) / len(SEEDS)
        regrets = [optimum - episode_return for episode_return, _ in runs]
        excess = max(float(np.max(costs - np.array(lesson.limits))) for _, costs in runs)
        kept = max(regrets) <= LARGEST_REGRET and excess <= LARGEST_EXCESS
        print(
            f"{lesson.agent:10}{lesson.task:20}{max(regrets):14.3f}{np.mean(regrets):8.3f}{excess:14.3f}"
            f"{seconds:8.1f}{'' if kept else '  misses'}",
            flush=True,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
