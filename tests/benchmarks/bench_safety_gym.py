"""How fast the Safety Gym tasks are, as a share of what MuJoCo alone would need.

python tests/benchmarks/bench_safety_gym.py [--tasks CarGoal2 ...] [--repeats 100] [--threads 2]

For every task, 16 environments under random actions, against the same 16 simulations stepped by ``mj_step``
alone in a Python loop ("bare"); and one environment of ``gymnasium.make``. They take turns
of a few steps, in one run on one core, so that a noisy machine hurts all alike. Times are CPU seconds of this
process, lower quartiles over the turns; a share is the median over the turns of neighbouring times. With
--threads: wall seconds, several threads against one. Resets are timed apart: an episode is 1,000 steps and
one reset.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import gymnasium
import mujoco
import numpy as np

from recrl.environments.cmdp import Floats
from recrl.environments.gremlins import leads
from recrl.environments.safety_gym import SafetyGymVectorEnv
from recrl.environments.safety_tasks import HORIZON, SAFETY_TASKS, SUBSTEPS
from recrl.environments.safety_worlds import SafetyWorlds

NUM_ENVS = 16
STEPS = 5
"""Steps of every environment in one repeat."""
# safety-gymnasium 1.0.0 on mujoco 2.3.7, environment steps/s on one core without and with resets.
PEER = {"CarGoal2": (357, 243), "CarButton2": (320, 207), "CarPush2": (623, 337)}
TASKS = [name for name in SAFETY_TASKS if name.startswith("Car") or name.endswith("2")]


def timed(work: Callable[[], object], clock: Callable[[], float]) -> float:
    start = clock()
    work()
    return clock() - start


class Bare:
    """Simulations stepped by MuJoCo alone."""

    def __init__(self, worlds: SafetyWorlds) -> None:
        self.model = worlds.scene.model
        self.datas = [mujoco.MjData(self.model) for _ in range(worlds.number)]
        self.generator = np.random.default_rng(0)
        self.gremlin = worlds.scene.gremlin_mocap
        self.restart(worlds)

    def restart(self, worlds: SafetyWorlds) -> None:
        state = mujoco.mjtState.mjSTATE_INTEGRATION.value
        for data, row in zip(self.datas, worlds.simulations.rows, strict=True):
            mujoco.mj_resetData(self.model, data)
            mujoco.mj_setState(self.model, data, row, state)
        chosen = np.arange(worlds.number if self.gremlin >= 0 else 0)
        self.circles = worlds.circles[chosen, worlds.embodied[chosen]]
        self.substeps = 0

    def steps(self) -> None:
        for controls in self.generator.uniform(-1.0, 1.0, (STEPS, len(self.datas), 2)):
            if len(self.circles):
                self.step_with_gremlins(controls)
                continue
            for data, control in zip(self.datas, controls, strict=True):
                data.ctrl[:] = control
                mujoco.mj_step(self.model, data, SUBSTEPS)

    def step_with_gremlins(self, controls: Floats) -> None:
        """One environment step; what leads a gremlin is moved before every physics step, as it must."""
        course = leads(self.model.opt.timestep, np.array([float(self.substeps)]))[0]
        self.substeps += SUBSTEPS
        for data, control, circle in zip(self.datas, controls, self.circles, strict=True):
            data.ctrl[:] = control
            lead = data.mocap_pos[self.gremlin]
            for place in course + np.append(circle, 0.0):
                lead[:] = place
                mujoco.mj_step(self.model, data)


def measure(name: str, repeats: int) -> tuple[Floats, Floats]:
    """CPU seconds of a step: bare, 16 environments, one; of a reset; and the shares of bare."""
    batch = SafetyGymVectorEnv(name, NUM_ENVS)
    single = gymnasium.make(f"recrl/{name}-v0")
    generator = np.random.default_rng(0)
    batch.reset(seed=0)
    single.reset(seed=0)
    bare = Bare(batch.worlds)
    resets = SafetyWorlds(SAFETY_TASKS[name], NUM_ENVS)
    resets.seed(0)

    def steps_of_batch() -> None:
        for actions in generator.uniform(-1.0, 1.0, (STEPS, NUM_ENVS, 2)):
            batch.step(actions)

    def steps_of_single() -> None:
        for action in generator.uniform(-1.0, 1.0, (4 * STEPS, 2)):
            _, _, terminated, truncated, _ = single.step(action)
            if terminated or truncated:
                single.reset()

    clock = time.process_time
    times: list[list[float]] = [[], [], [], []]
    for _ in range(10):  # vases fall asleep
        bare.steps()
        steps_of_batch()
        steps_of_single()
    for repeat in range(repeats):
        if repeat % 100 == 99:  # new layouts for both
            batch.reset()
            bare.restart(batch.worlds)
        times[0].append(timed(bare.steps, clock) / (STEPS * NUM_ENVS))
        times[1].append(timed(steps_of_batch, clock) / (STEPS * NUM_ENVS))
        times[2].append(timed(steps_of_single, clock) / (4 * STEPS))
        if repeat < 8:
            times[3].append(timed(lambda: resets.restart(np.arange(NUM_ENVS)), clock) / NUM_ENVS)
    shares = [np.median(np.array(times[0]) / np.array(series)) for series in times[1:3]]
    return np.array([np.quantile(series, 0.25) for series in times]), np.array(shares)


def thread_gain(name: str, repeats: int, num_threads: int) -> float:
    """Wall seconds of a step on one thread over those on several, best of the repeats."""
    batches = [SafetyGymVectorEnv(name, NUM_ENVS, num_threads=number) for number in (1, num_threads)]
    generator = np.random.default_rng(0)
    for batch in batches:
        batch.reset(seed=0)
    times: list[list[float]] = [[], []]
    for _ in range(repeats):
        drawn = generator.uniform(-1.0, 1.0, (STEPS, NUM_ENVS, 2))
        for batch, series in zip(batches, times, strict=True):
            start = time.perf_counter()
            for actions in drawn:
                batch.step(actions)
            series.append(time.perf_counter() - start)
    return min(times[0]) / min(times[1])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=list(SAFETY_TASKS))
    parser.add_argument("--repeats", type=int, default=100)
    parser.add_argument("--threads", type=int, default=0, help="also measure the gain from this many threads")
    arguments = parser.parse_args()
    print("environment steps per CPU second; N = 16 unless said otherwise\n")
    print(
        "| task | bare | ours | with resets | share of bare | one env | share of bare | x peer, with resets |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in arguments.tasks:
        (bare, batch, single, reset), shares = measure(name, arguments.repeats)
        whole = HORIZON / (HORIZON * batch + reset)
        peer = PEER.get(name)
        versus = f"{1 / batch / peer[0]:.1f}, {whole / peer[1]:.1f}" if peer else ""
        print(
            f"| {name} | {1 / bare:,.0f} | {1 / batch:,.0f} | {whole:,.0f} | {shares[0]:.2f} "
            f"| {1 / single:,.0f} | {shares[1]:.2f} | {versus} |",
            flush=True,
        )
        if arguments.threads:
            gain = thread_gain(name, arguments.repeats, arguments.threads)
            print(f"  {name}: {arguments.threads} threads, wall time: {gain:.2f}x")


if __name__ == "__main__":
    main()
