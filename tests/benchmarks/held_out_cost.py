"""How well networks predict the cost to come from raw lidar values, proximity features, a convolution.

    OMP_NUM_THREADS=1 python tests/benchmarks/held_out_cost.py TRIAL [TRIAL ...] --to rows.csv

A TRIAL is the folder of a complete trial on a Safety Gym task. Its final policy runs 192 episodes. Networks
are fitted to the discounted cost of the steps to come in 96 of them, stopped by 32, and judged on the other
64, whose layouts differ. A row is the share of the variance that a network explains there:

- ``raw``: a perceptron of the observation.
- ``proximity``: the same with the encoder that agents have by default.
- ``convolution``: of the observation; one small network for all directions, circular, learnt from raw values.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd
import torch
from torch import nn

import recrl
from recrl.agents.collection import Collector
from recrl.agents.observation_features import Encoder
from recrl.environments.cmdp import CMDPSpec
from recrl.environments.registry import make_vector
from recrl.orchestrator.files.trial_store import TrialStore

DISCOUNTS = (0.9, 0.97, 0.99)
EPISODES, TRAINED, STOPPED = 192, 96, 32
LAST_STEP, EVERY = 700, 5  # of an episode's 1,000 steps: later ones have too few steps to come
WIDTH, BATCH, EPOCHS, PATIENCE = 64, 256, 100, 8
Rows = npt.NDArray[np.float32]


class Convolution(nn.Module):
    """A perceptron of the observation and of a circular convolution over the directions of its lidars."""

    def __init__(self, cmdp: CMDPSpec) -> None:
        super().__init__()
        ends = np.cumsum([part.size for part in cmdp.components])
        self.lidars = [
            slice(int(end) - part.size, int(end))
            for part, end in zip(cmdp.components, ends, strict=True)
            if part.lidar_range is not None
        ]
        channels, directions = len(self.lidars), self.lidars[0].stop - self.lidars[0].start
        self.directions = nn.Sequential(
            nn.Conv1d(channels, 16, 1),
            nn.Tanh(),
            nn.Conv1d(16, 16, 3, padding=1, padding_mode="circular"),
            nn.Tanh(),
            nn.Conv1d(16, 4, 1),
            nn.Tanh(),
        )
        self.rest = perceptron(int(ends[-1]) + 4 * directions)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Predict the cost to come, [N, n] -> [N, 1]."""
        stacked = torch.stack([rows[:, lidar] for lidar in self.lidars], dim=1)
        value: torch.Tensor = self.rest(torch.cat([rows, self.directions(stacked).flatten(1)], dim=1))
        return value


def perceptron(inputs: int) -> nn.Sequential:
    """Return a network of the size that critics have by default."""
    return nn.Sequential(
        nn.Linear(inputs, WIDTH), nn.Tanh(), nn.Linear(WIDTH, WIDTH), nn.Tanh(), nn.Linear(WIDTH, 1)
    )


def episodes(trial: Path) -> tuple[CMDPSpec, Rows, Rows]:
    """Run the final policy: observations [T, E, n] and costs [T, E] of E whole episodes."""
    task = TrialStore(trial).spec.task
    environments = make_vector(task.name, EPISODES // 3, options=task.options)
    collector = Collector(environments, num_steps=environments.cmdp.horizon or 1)
    collector.reset(seed=0)
    policy, generator = recrl.load_policy(trial).final, np.random.default_rng(0)
    rollouts = [collector.collect(policy, generator)[0] for _ in range(3)]
    return (
        environments.cmdp,
        np.concatenate([rollout.observations for rollout in rollouts], axis=1),
        np.concatenate([rollout.costs[..., 0] for rollout in rollouts], axis=1).astype(np.float32),
    )


def costs_to_come(costs: Rows, discount: float) -> Rows:
    """Return the discounted sum from each step to the end of its episode, [T, E] -> [T, E]."""
    sums = np.zeros_like(costs)
    following = np.zeros(costs.shape[1], np.float32)
    for step in reversed(range(len(costs))):
        following = costs[step] + np.float32(discount) * following
        sums[step] = following
    return sums


def explained(
    make: Callable[[], nn.Module], inputs: list[torch.Tensor], targets: list[torch.Tensor], seed: int
) -> float:
    """Fit a network; return the share of the variance that it explains on the last part of three."""
    torch.manual_seed(seed)
    network = make()
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    mean, spread = targets[0].mean(), targets[0].std()
    best, best_loss, waited = copy.deepcopy(network), np.inf, 0
    for _ in range(EPOCHS):
        for batch in torch.split(torch.randperm(len(inputs[0])), BATCH):
            error = network(inputs[0][batch])[:, 0] - (targets[0][batch] - mean) / spread
            optimiser.zero_grad()
            error.square().mean().backward()
            optimiser.step()
        with torch.no_grad():
            loss = float((network(inputs[1])[:, 0] - (targets[1] - mean) / spread).square().mean())
        waited = 0 if loss < best_loss else waited + 1
        if loss < best_loss:
            best, best_loss = copy.deepcopy(network), loss
        if waited == PATIENCE:
            break
    with torch.no_grad():
        residual = best(inputs[2])[:, 0] * spread + mean - targets[2]
    return float(1.0 - residual.var() / targets[2].var())


def measure(trial: Path, repetitions: int) -> pd.DataFrame:
    """Return a row for each network, discount and repetition."""
    cmdp, observations, costs = episodes(trial)
    steps, n = np.arange(0, LAST_STEP, EVERY), observations.shape[-1]
    encoder = Encoder(n, cmdp.components, scales=(0.15, 0.4), normalise=np.zeros(n, np.bool_))
    parts = np.split(np.arange(EPISODES), [TRAINED, TRAINED + STOPPED])

    def rows(values: Rows) -> list[torch.Tensor]:
        return [
            torch.from_numpy(values[steps][:, part].reshape(-1, *values.shape[2:]).copy()) for part in parts
        ]

    raw = rows(observations)
    near = [torch.from_numpy(encoder(part.numpy()).astype(np.float32)) for part in raw]
    networks: dict[str, tuple[Callable[[], nn.Module], list[torch.Tensor]]] = {
        "raw": (lambda: perceptron(n), raw),
        "proximity": (lambda: perceptron(encoder.size), near),
        "convolution": (lambda: Convolution(cmdp), raw),
    }
    found = []
    for discount in DISCOUNTS:
        targets = rows(costs_to_come(costs, discount))
        for name, (make, inputs) in networks.items():
            for seed in range(repetitions):
                share = explained(make, inputs, targets, seed)
                found.append((cmdp.name, TrialStore(trial).spec.seed, name, discount, seed, round(share, 3)))
                print(*found[-1], flush=True)
    return pd.DataFrame(
        found, columns=["task", "policy_seed", "network", "discount", "fit_seed", "explained_variance"]
    )


def main() -> None:
    """Measure some trials."""
    parser = argparse.ArgumentParser(description="How well networks predict the cost to come.")
    parser.add_argument("trials", nargs="+", type=Path, metavar="TRIAL")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--to", type=Path, required=True)
    given = parser.parse_args()
    tables = [measure(trial, given.repetitions) for trial in given.trials]
    pd.concat(tables).to_csv(given.to, index=False, lineterminator="\n")


if __name__ == "__main__":
    main()
