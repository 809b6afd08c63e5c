"""How many environment steps a student learns from in a CPU second, and what the time goes into.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_end_to_end.py [--tasks stub CarGoal2] [--updates 1]

One update of 20,000 steps: 20 environments of 1,000 steps each, on one core, all in ``recommended`` but the
networks' widths. ``stub`` is an environment that costs nothing (72 observations, 2 actions); the aim is 3,000
steps a CPU second with 256 x 256 units. On CarGoal2, beside OmniSafe's figure on the same task, steps and
widths, the aim is twenty times as many.

The bound is the time of the matrix products of the networks alone (see ``bench_update.py``).
Memory is the growth of what this process holds from one update to the next.
"""

from __future__ import annotations

import argparse
import resource
import runpy
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space

from recrl.agents.agent import Policy
from recrl.agents.collect import Collector, episode_costs
from recrl.agents.config import StudentConfig
from recrl.agents.registry import agent_config, make_agent
from recrl.environments.cmdp import CMDPSpec
from recrl.environments.registry import make_vector
from recrl.environments.vector import CMDPVectorEnv

NUM_ENVS, NUM_STEPS = 20, 1000
NUM_OBSERVATIONS, NUM_ACTIONS = 72, 2
LIMITS = np.array([25.0])
WIDTHS = ([256, 256], [64, 64])
# OmniSafe's steps per CPU second on CarGoal2, 20,000 steps, 256 x 256, one update, one core.
OMNISAFE = {"ppo-lag": 89.0, "cpo": 118.0}


class Stub(CMDPVectorEnv):
    """Environments that cost nothing: noise drawn beforehand, episodes of 1,000 steps."""

    def __init__(self, num_envs: int) -> None:
        box = Box(-np.inf, np.inf, (NUM_OBSERVATIONS,), np.float32)
        actions = Box(-1.0, 1.0, (NUM_ACTIONS,), np.float32)
        self.num_envs = num_envs
        self.cmdp = CMDPSpec("stub", box, actions, ("cost",), NUM_STEPS)
        self.single_observation_space, self.single_action_space = box, actions
        self.observation_space, self.action_space = batch_space(box, num_envs), batch_space(actions, num_envs)
        drawn = np.random.default_rng(0).normal(size=(NUM_STEPS, num_envs, NUM_OBSERVATIONS))
        self._observations = drawn.astype(np.float32)
        self._rewards = drawn[..., 0].copy()
        self._costs = (drawn[..., 1:2] > 1.5).astype(np.float64)
        self._never = np.zeros(num_envs, np.bool_)
        self._step = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        self._step = 0
        return self._observations[0], {}

    def step(self, actions: npt.NDArray[np.float32]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        now, self._step = self._step, (self._step + 1) % NUM_STEPS
        info: dict[str, Any] = {"cost": self._costs[now]}
        truncated = self._never
        if self._step == 0:
            truncated, info["final_obs"] = ~self._never, self._observations[now]
        return self._observations[self._step], self._rewards[now], self._never, truncated, info

    def state_dict(self) -> dict[str, Any]:
        return {"step": self._step}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._step = state["step"]


@dataclass
class Timed:
    """A policy that knows how long it took to act, in CPU seconds."""

    policy: Policy
    seconds: float = 0.0

    def act(self, observations: npt.NDArray[np.float32], generator: np.random.Generator) -> npt.NDArray[Any]:
        start = time.thread_time()
        actions = self.policy.act(observations, generator)
        self.seconds += time.thread_time() - start
        return actions


class TimedSteps(CMDPVectorEnv):
    """Environments that know how long they took to step, in CPU seconds."""

    def __init__(self, environments: CMDPVectorEnv) -> None:
        self._environments = environments
        self.num_envs, self.cmdp = environments.num_envs, environments.cmdp
        self.seconds = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        return self._environments.reset(seed=seed, options=options)

    def step(self, actions: npt.NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        start = time.thread_time()
        stepped = self._environments.step(actions)
        self.seconds += time.thread_time() - start
        return stepped

    def state_dict(self) -> dict[str, Any]:
        return self._environments.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._environments.load_state_dict(state)


def held_megabytes() -> float:
    """The most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def measure(task: str, agent_name: str, widths: list[int], updates: int) -> tuple[dict[str, float], float]:
    """CPU seconds of all updates by what they went into, and by how much memory grew after the first."""
    environments = TimedSteps(Stub(NUM_ENVS) if task == "stub" else make_vector(task, NUM_ENVS))
    options = {"hidden_sizes": widths}
    config = agent_config(agent_name, options)
    assert isinstance(config, StudentConfig)
    agent = make_agent(agent_name, environments.cmdp, options, np.random.SeedSequence(0))
    collector = Collector(environments, num_steps=NUM_STEPS)
    collector.reset(seed=0)
    generator = np.random.default_rng(0)
    policy = Timed(agent)
    collecting = updating = flops = first_megabytes = 0.0
    bench = runpy.run_path(str(Path(__file__).with_name("bench_update.py")))
    rate = bench["flops_a_millisecond"]()
    for _ in range(updates):
        start = time.thread_time()
        rollout, episodes = collector.collect(policy, generator)
        middle = time.thread_time()
        metrics = agent.update(rollout, episode_costs(episodes, 1), LIMITS)
        collecting += middle - start
        updating += time.thread_time() - middle
        flops += bench["update_flops"](config, metrics, NUM_ENVS * NUM_STEPS)
        flops += bench["forward_flops"](NUM_ENVS * NUM_STEPS, (NUM_OBSERVATIONS, *widths, NUM_ACTIONS))
        first_megabytes = first_megabytes or held_megabytes()
    rate = max(rate, bench["flops_a_millisecond"]())
    seconds = {
        "environment": environments.seconds,
        "inference": policy.seconds,
        "storage": collecting - environments.seconds - policy.seconds,
        "update": updating,
        "bound": flops / rate / 1e3,
    }
    return seconds, held_megabytes() - first_megabytes


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=["stub", "CarGoal2"])
    parser.add_argument("--agents", nargs="+", default=["ppo-lag", "cpo"])
    parser.add_argument("--updates", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    steps = NUM_ENVS * NUM_STEPS * arguments.updates
    print(f"{steps:,} steps, {NUM_ENVS} environments; CPU seconds")
    columns = ("environment", "inference", "storage", "update", "bound")
    print(
        f"{'task':<10}{'student':<9}{'widths':<9}"
        + "".join(f"{column:>12}" for column in columns)
        + f"{'steps/s':>9}{'OmniSafe':>10}{'times':>7}{'MB more':>9}"
    )
    for task in arguments.tasks:
        for agent_name in arguments.agents:
            for widths in WIDTHS:
                seconds, megabytes = measure(task, agent_name, widths, arguments.updates)
                speed = steps / sum(seconds[column] for column in columns[:-1])
                peer = OMNISAFE.get(agent_name) if task == "CarGoal2" and widths == WIDTHS[0] else None
                versus = f"{peer:>10.0f}{speed / peer:>7.1f}" if peer else f"{'':>17}"
                print(
                    f"{task:<10}{agent_name:<9}{'x'.join(map(str, widths)):<9}"
                    + "".join(f"{seconds[column]:>12.2f}" for column in columns)
                    + f"{speed:>9,.0f}{versus}{megabytes:>9.1f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
