"""How many environment steps an agent learns from in a CPU second, and what the time goes into.

    OMP_NUM_THREADS=1 python tests/benchmarks/bench_end_to_end.py [--tasks stub CarGoal2] [--repeats 3]

One update of 20,000 steps: 20 environments of 1,000 steps each, on one core, all in ``recommended`` but the
networks' widths. ``stub`` is an environment that costs nothing (72 observations, 2 actions); the aim is 3,000
steps a CPU second with 256 x 256 units. On CarGoal2, beside OmniSafe's figure on the same task, steps and
widths, the aim is twenty times as many. Of several repeats the one of median speed is shown.

The bound is the time of the matrix products of the networks alone (see ``bench_update.py``).
With several updates, memory is the growth of what this process holds after the first.

OmniSafe's figures are from a quiet machine of this kind, on which MuJoCo alone made 4,961 steps a second of
CarGoal2 (see ``bench_safety_gym.py``). What the machine gives changes by the hour, so MuJoCo alone takes its
turn after every 50 steps here too: ``bare``, steps/s. ``then`` is how many times OmniSafe's steps it would be
with the environment's seconds at the speed that MuJoCo had then, all others as they were measured.
"""

from __future__ import annotations

import argparse
import resource
import runpy
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space

from recrl.agents.agent import Policy
from recrl.agents.collection import Collector, episode_costs
from recrl.agents.registry import agent_config, make_agent
from recrl.agents.shared_options import ActorCriticConfig
from recrl.environments.cmdp import CMDPSpec, CostLimits, CurriculumStep
from recrl.environments.registry import make_vector
from recrl.environments.safety_gym.safety_gym_environments import SafetyGymVectorEnv
from recrl.environments.vector import CMDPVectorEnv

UPDATE, SAFETY_GYM = (
    runpy.run_path(str(Path(__file__).with_name(name))) for name in ("bench_update.py", "bench_safety_gym.py")
)
NUM_ENVS, NUM_STEPS = 20, 1000
NUM_OBSERVATIONS, NUM_ACTIONS = 72, 2
STEP = CurriculumStep(CostLimits((25.0,)))
WIDTHS = ([256, 256], [64, 64])
# OmniSafe's steps per CPU second on CarGoal2, 20,000 steps, 256 x 256, one update, one core.
OMNISAFE = {"ppo-lag": 89.0, "cpo": 118.0}
# Steps between two turns of MuJoCo alone.
TURN = 50


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

    def restart(self, index: npt.NDArray[np.intp]) -> npt.NDArray[np.float32]:
        now: npt.NDArray[np.float32] = self._observations[self._step]
        return now

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
    """Environments that know how long they took to step, in CPU seconds, and how long a rival takes.

    Args:
        environments: what is stepped.
        rival: takes its turn now and then, if there is one.

    Attributes:
        seconds: of the environments.
        rival_seconds: of each turn of the rival.
    """

    def __init__(self, environments: CMDPVectorEnv, rival: Callable[[], None] | None) -> None:
        self._environments, self._rival = environments, rival
        self.num_envs, self.cmdp = environments.num_envs, environments.cmdp
        self.seconds, self.rival_seconds = 0.0, list[float]()
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        return self._environments.reset(seed=seed, options=options)

    def step(self, actions: npt.NDArray[Any]) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        start = time.thread_time()
        stepped = self._environments.step(actions)
        end = time.thread_time()
        self.seconds += end - start
        self._steps += 1
        if self._rival is not None and self._steps % TURN == 0:
            self._rival()
            self.rival_seconds.append(time.thread_time() - end)
        return stepped

    def restart(self, index: npt.NDArray[np.intp]) -> Any:
        return self._environments.restart(index)

    def state_dict(self) -> dict[str, Any]:
        return self._environments.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._environments.load_state_dict(state)


def held_megabytes() -> float:
    """The most memory that this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


@dataclass(frozen=True)
class Measured:
    """Some updates of an agent.

    Attributes:
        seconds: CPU seconds by what they went into.
        bound: those of the networks' matrix products.
        megabytes: how much more memory was held than after the first update.
        bare: steps a CPU second of MuJoCo alone meanwhile; NaN where there is none.
    """

    seconds: dict[str, float]
    bound: float
    megabytes: float
    bare: float

    @property
    def total(self) -> float:
        """CPU seconds in all."""
        return sum(self.seconds.values())

    def total_at(self, bare: float) -> float:
        """CPU seconds in all, had MuJoCo alone made so many steps a second."""
        return self.total - self.seconds["environment"] * (1.0 - self.bare / bare)


def measure(task: str, agent_name: str, widths: list[int], updates: int) -> Measured:
    """Collect and learn; what it takes."""
    made = Stub(NUM_ENVS) if task == "stub" else make_vector(task, NUM_ENVS)
    made.reset(seed=0)
    rival = SAFETY_GYM["Bare"](made.batch) if isinstance(made, SafetyGymVectorEnv) else None
    environments = TimedSteps(made, rival.steps if rival else None)
    options = {"hidden_sizes": widths}
    config = agent_config(agent_name, options)
    assert isinstance(config, ActorCriticConfig)
    agent = make_agent(agent_name, environments.cmdp, options, np.random.SeedSequence(0))
    collector = Collector(environments, num_steps=NUM_STEPS)
    collector.reset(seed=0)
    generator = np.random.default_rng(0)
    policy = Timed(agent)
    collecting = updating = flops = first_megabytes = 0.0
    rate = UPDATE["flops_a_millisecond"]()
    for _ in range(updates):
        start = time.thread_time()
        rollout, episodes = collector.collect(policy, generator)
        middle = time.thread_time()
        metrics = agent.update(rollout, episode_costs(episodes, 1), STEP)
        collecting += middle - start
        updating += time.thread_time() - middle
        flops += UPDATE["update_flops"](config, metrics, NUM_ENVS * NUM_STEPS)
        flops += UPDATE["forward_flops"](NUM_ENVS * NUM_STEPS, (NUM_OBSERVATIONS, *widths, NUM_ACTIONS))
        first_megabytes = first_megabytes or held_megabytes()
    rate = max(rate, UPDATE["flops_a_millisecond"]())
    rival_seconds = environments.rival_seconds
    seconds = {
        "environment": environments.seconds,
        "inference": policy.seconds,
        "storage": collecting - environments.seconds - sum(rival_seconds) - policy.seconds,
        "update": updating,
    }
    rival_steps = SAFETY_GYM["STEPS"] * NUM_ENVS
    bare = rival_steps * len(rival_seconds) / sum(rival_seconds) if rival_seconds else float("nan")
    return Measured(seconds, flops / rate / 1e3, held_megabytes() - first_megabytes, bare)


def row(task: str, agent_name: str, widths: list[int], steps: int, found: Measured) -> str:
    """A line of the table."""
    cells = [f"{seconds:>12.2f}" for seconds in (*found.seconds.values(), found.bound)]
    cells.append(f"{steps / found.total:>9,.0f}")
    if task == "CarGoal2":
        cells.append(f"{found.bare:>8,.0f}")
    if task == "CarGoal2" and widths == WIDTHS[0] and agent_name in OMNISAFE:
        peer, then = OMNISAFE[agent_name], SAFETY_GYM["PEER"][task][2]
        times = steps / found.total / peer, steps / found.total_at(then) / peer
        cells.append(f"{peer:>10.0f}{times[0]:>7.1f}{times[1]:>7.1f}")
    return f"{task:<10}{agent_name:<9}{'x'.join(map(str, widths)):<9}" + "".join(cells)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=["stub", "CarGoal2"])
    parser.add_argument("--agents", nargs="+", default=["ppo-lag", "cpo"])
    parser.add_argument("--widths", nargs="+", type=int, default=[width[0] for width in WIDTHS])
    parser.add_argument("--updates", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    steps = NUM_ENVS * NUM_STEPS * arguments.updates
    print(f"{steps:,} steps, {NUM_ENVS} environments; CPU seconds")
    columns = ("environment", "inference", "storage", "update", "bound")
    print(
        f"{'task':<10}{'agent':<9}{'widths':<9}"
        + "".join(f"{column:>12}" for column in columns)
        + f"{'steps/s':>9}{'bare':>8}{'OmniSafe':>10}{'times':>7}{'then':>7}"
    )
    most_megabytes = 0.0
    for task in arguments.tasks:
        for agent_name in arguments.agents:
            for width in arguments.widths:
                widths = [width, width]
                found = sorted(
                    (measure(task, agent_name, widths, arguments.updates) for _ in range(arguments.repeats)),
                    key=lambda measured: measured.total,
                )
                most_megabytes = max(most_megabytes, *(each.megabytes for each in found))
                print(row(task, agent_name, widths, steps, found[len(found) // 2]), flush=True)
    if arguments.updates > 1:
        print(f"memory held grew by at most {most_megabytes:.1f} MB after the first update")


if __name__ == "__main__":
    main()
