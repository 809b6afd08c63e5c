"""What a trial costs with networks that PyTorch differentiates, beside the standard perceptron.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_networks.py [--updates 6]

For each task, agent and size two trials run in turns, one with the standard perceptron and
one with the same layers as a ``torch.nn.Module``. Printed are the CPU milliseconds of an update with
the steps that it learns from, and their ratio, the median over the pairs.
"""

from __future__ import annotations

import argparse
import itertools
import time
from typing import Any

import numpy as np
import torch
from torch import nn

from recrl.agents.collection import Collector, episode_costs
from recrl.agents.registry import make_agent
from recrl.environments.cmdp import CostLimits, CurriculumStep
from recrl.environments.registry import make_vector

TASKS = {"rivergrid-1a": 5.0, "CarGoal2": 25.0}
AGENTS = ("ppo-lag", "cpo")
SIZES = ((64, 64), (256, 256))


def small(num_inputs: int, num_outputs: int) -> nn.Module:
    """64 x 64 tanh units."""
    return _module((num_inputs, 64, 64, num_outputs))


def large(num_inputs: int, num_outputs: int) -> nn.Module:
    """256 x 256 tanh units."""
    return _module((num_inputs, 256, 256, num_outputs))


def _module(sizes: tuple[int, ...]) -> nn.Module:
    layers = [part for pair in itertools.pairwise(sizes) for part in (nn.Linear(*pair), nn.Tanh())]
    return nn.Sequential(*layers[:-1])


class Trial:
    """An agent and its task, advanced update by update."""

    def __init__(self, task: str, agent: str, options: dict[str, Any]) -> None:
        environments = make_vector(task, 64)
        self.step = CurriculumStep(CostLimits((TASKS[task],)))
        self.agent = make_agent(agent, environments.cmdp, options, np.random.SeedSequence(0))
        self.collector = Collector(environments, num_steps=64)
        self.collector.reset(seed=0)
        self.generator = np.random.default_rng(0)

    def update(self) -> float:
        """CPU seconds of 4,096 steps and what is learnt from them."""
        start = time.process_time()
        rollout, episodes = self.collector.collect(self.agent, self.generator)
        self.agent.update(rollout, episode_costs(episodes, 1), self.step)
        return time.process_time() - start


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--updates", type=int, default=6)
    updates = parser.parse_args().updates
    torch.set_num_threads(1)
    print("task          agent     units   perceptron ms   module ms   ratio")
    for task, agent, sizes in itertools.product(TASKS, AGENTS, SIZES):
        own = {"network": f"{__name__}:{'small' if sizes[0] == 64 else 'large'}"}
        ours, theirs = Trial(task, agent, {"hidden_sizes": sizes}), Trial(task, agent, own)
        ours.update(), theirs.update()
        pairs = np.array([(ours.update(), theirs.update()) for _ in range(updates)])
        ratio = float(np.median(pairs[:, 1] / pairs[:, 0]))
        fast, slow = 1e3 * np.median(pairs, axis=0)
        print(f"{task:13} {agent:9} {sizes[0]:5}   {fast:13.0f}   {slow:9.0f}   {ratio:5.2f}", flush=True)


if __name__ == "__main__":
    main()
