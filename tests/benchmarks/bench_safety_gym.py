"""How fast the Safety Gym tasks are, as a share of what MuJoCo alone would need.

python tests/benchmarks/bench_safety_gym.py [--tasks CarGoal2 ...] [--repeats 100] [--threads 2]

For every task, 16 environments under random actions, against the same 16 simulations stepped by
``mj_step(model, data, 10)`` alone in a Python loop ("bare"); and one environment of ``gymnasium.make``. They
take turns of 80 steps, all the same, in one run on one core, so that a noisy machine hurts all alike. Times
are CPU seconds of this process, lower quartiles over the turns; a share is the median over the turns of
neighbouring times. With --threads: wall seconds, several threads against one, for us and for MuJoCo's batch
alone; and several processes against one, in each of which MuJoCo alone steps simulations of its own: they
share nothing, so their gain is what the machine's cores give when all are busy. What threads lose, they lose
once a step, in waking up and waiting for the last; so their gain is also measured with 64 environments.
Resets are timed apart: an episode is 1,000 steps and one reset.

In Button a gremlin is led: what it is tied to must move before every physics step, which ``mj_step`` with a
count cannot do. So there are two bare speeds: "bare", the same call as elsewhere, in which the gremlin hangs
still, tied to a lead that does not move; and "led", ten calls of ``mj_step`` with the lead moved in between,
which is what the task's physics needs. The first is the higher hurdle: it does less than the task, and pays
for Python once instead of ten times. In both the gremlin is tied throughout, as in the model. Ours tie it
only while the robot is near, and that is part of the measurement.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.queues import Queue
from multiprocessing.synchronize import Barrier
from typing import Any

import gymnasium
import mujoco
import mujoco.batch
import numpy as np

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.gremlins import leads
from recrl.environments.safety_gym.safety_gym_batch import SafetyGymBatch
from recrl.environments.safety_gym.safety_gym_environments import SafetyGymVectorEnv
from recrl.environments.safety_gym.scene import PARKED
from recrl.environments.safety_gym.task_definitions import HORIZON, SAFETY_TASKS, SUBSTEPS

NUM_ENVS, MANY_ENVS = 16, 64
STEPS = 5
"""Steps of every environment in one repeat."""
ROLLOUT = 20
"""The same where threads are compared: a rollout has hundreds, and only at its start do threads sleep."""
ROUNDS, TURN_SECONDS = 10, 0.4
"""Turns of one process and of several, and the wall seconds of each."""
# safety-gymnasium 1.0.0 on mujoco 2.3.7, environment steps/s on one core without and with resets, and bare
# MuJoCo's in the same run: what the machine gives changes by the hour, so that its speed then counts.
PEER = {"CarGoal2": (357, 243, 4961), "CarButton2": (320, 207, 3862), "CarPush2": (623, 337, 5450)}
TASKS = [name for name in SAFETY_TASKS if name.startswith("Car") or name.endswith("2")]


def timed(work: Callable[[], object], clock: Callable[[], float]) -> float:
    start = clock()
    work()
    return clock() - start


class Bare:
    """Simulations stepped by MuJoCo alone."""

    def __init__(self, batch: SafetyGymBatch) -> None:
        self.model = batch.scene.model
        self.datas = [mujoco.MjData(self.model) for _ in range(batch.number)]
        self.generator = np.random.default_rng(0)
        self.restart(batch)

    def restart(self, batch: SafetyGymBatch) -> None:
        """Begin where the environments are; gremlins where the model has them."""
        state, scene = mujoco.mjtState.mjSTATE_INTEGRATION.value, batch.scene
        for data, row in zip(self.datas, batch.simulations.rows, strict=True):
            mujoco.mj_resetData(self.model, data)
            mujoco.mj_setState(self.model, data, row, state)
            if scene.gremlin_mocap >= 0:
                data.qpos[scene.gremlin_qpos :] = self.model.qpos0[scene.gremlin_qpos :]
                data.qvel[scene.gremlin_qvel :], data.qfrc_applied[:], data.eq_active[:] = 0.0, 0.0, 1
                data.mocap_pos[scene.gremlin_mocap] = data.qpos[scene.gremlin_qpos :][:3]

    def steps(self) -> None:
        """Take some environment steps under random controls."""
        for controls in self.generator.uniform(-1.0, 1.0, (STEPS, len(self.datas), 2)):
            for data, control in zip(self.datas, controls, strict=True):
                data.ctrl[:] = control
                mujoco.mj_step(self.model, data, SUBSTEPS)


class Led(Bare):
    """Simulations whose gremlin is led, stepped by MuJoCo alone."""

    def restart(self, batch: SafetyGymBatch) -> None:
        """Begin where the environments are."""
        super().restart(batch)
        self.gremlin = batch.scene.gremlin_mocap
        self.substeps = 0

    def steps(self) -> None:
        """Take some environment steps under random controls."""
        for controls in self.generator.uniform(-1.0, 1.0, (STEPS, len(self.datas), 2)):
            course = leads(self.model.opt.timestep, self.substeps)
            self.substeps += SUBSTEPS
            course[:, 1] += PARKED
            for data, control in zip(self.datas, controls, strict=True):
                data.ctrl[:] = control
                lead = data.mocap_pos[self.gremlin]
                for place in course:
                    lead[:] = place
                    mujoco.mj_step(self.model, data)


def measure(name: str, repeats: int) -> tuple[Floats, Floats]:
    """CPU seconds of a step: 16 environments, one, bare, bare and led; of a reset; and shares of bare.

    Returns:
        the five times (led is NaN where there are no gremlins), and the shares of 16 and of one environment
        of the bare speed, and of 16 of the led one.
    """
    batch = SafetyGymVectorEnv(name, NUM_ENVS)
    single = gymnasium.make(f"recrl.environments.registration:recrl/{name}-v0")
    generator = np.random.default_rng(0)
    batch.reset(seed=0)
    single.reset(seed=0)
    rivals: list[Bare] = [Bare(batch.batch)]
    if SAFETY_TASKS[name].gremlins.number:
        rivals.append(Led(batch.batch))
    resets = SafetyGymBatch(SAFETY_TASKS[name], NUM_ENVS)
    resets.seed(0)

    def steps_of_batch() -> None:
        for actions in generator.uniform(-1.0, 1.0, (STEPS, NUM_ENVS, 2)):
            batch.step(actions)

    def steps_of_single() -> None:
        for action in generator.uniform(-1.0, 1.0, (STEPS * NUM_ENVS, 2)):
            _, _, terminated, truncated, _ = single.step(action)
            if terminated or truncated:
                single.reset()

    turns = [steps_of_batch, steps_of_single, *(rival.steps for rival in rivals)]
    clock = time.process_time
    times = np.full((4, repeats), np.nan)
    for _ in range(10):  # vases fall asleep
        for turn in turns:
            turn()
    for repeat in range(repeats):
        if repeat % 100 == 99:  # new layouts for all
            batch.reset()
            for rival in rivals:
                rival.restart(batch.batch)
        for row, turn in enumerate(turns):
            times[row, repeat] = timed(turn, clock) / (STEPS * NUM_ENVS)
    reset = [timed(lambda: resets.restart(np.arange(NUM_ENVS)), clock) / NUM_ENVS for _ in range(8)]
    shares = np.median([times[2] / times[0], times[2] / times[1], times[3] / times[0]], axis=1)
    return np.append(np.quantile(times, 0.25, axis=1), np.quantile(reset, 0.25)), shares


class Batch:
    """MuJoCo's own batch, which steps simulations on its own threads and computes nothing of ours."""

    def __init__(self, batch: SafetyGymBatch, num_threads: int) -> None:
        model, rows = batch.scene.model, batch.simulations.rows
        self.batch: Any = mujoco.batch.Batch(model, batch.number, nthread=num_threads, persistent=True)
        data, state = mujoco.MjData(model), mujoco.mjtState.mjSTATE_INTEGRATION.value
        for index, row in enumerate(rows):
            mujoco.mj_setState(model, data, row, state)
            for name in ("qpos", "qvel", "mocap_pos", "mocap_quat", "qfrc_applied", "eq_active"):
                getattr(self.batch, name)[index] = getattr(data, name)
        self.batch.forward()

    def step(self, actions: Floats) -> None:
        self.batch.ctrl[...] = actions
        self.batch.step(nstep=SUBSTEPS, stage=mujoco.mjtStage.mjSTAGE_ACC)


def thread_gains(name: str, num_envs: int, repeats: int, num_threads: int) -> tuple[float, float]:
    """Wall seconds of a step on one thread over those on several, medians over neighbouring turns.

    Returns:
        our gain, and that of MuJoCo's batch.
    """
    ours = [SafetyGymVectorEnv(name, num_envs, num_threads=number) for number in (1, num_threads)]
    for environment in ours:
        environment.reset(seed=0)
    theirs = [Batch(ours[0].batch, number) for number in (1, num_threads)]
    rivals: list[Any] = [*ours, *theirs]
    generator = np.random.default_rng(0)
    times = np.zeros((4, repeats))
    for repeat in range(repeats):
        drawn = generator.uniform(-1.0, 1.0, (ROLLOUT, num_envs, 2))
        for row, rival in enumerate(rivals):
            start = time.perf_counter()
            for actions in drawn:
                rival.step(actions)
            times[row, repeat] = time.perf_counter() - start
    gains = np.median([times[0] / times[1], times[2] / times[3]], axis=1)
    return float(gains[0]), float(gains[1])


def step_in_turns(
    name: str, rank: int, rounds: int, barrier: Barrier, counts: Queue[tuple[bool, int, int]]
) -> None:
    """What one of several processes does: step alone if it is the first, then with all others."""
    environments = SafetyGymVectorEnv(name, NUM_ENVS)
    environments.reset(seed=rank)
    bare = Bare(environments.batch)
    for turn in range(rounds):
        for together in (False, True):
            barrier.wait()
            if rank > 0 and not together:
                continue
            steps, end = 0, time.perf_counter() + TURN_SECONDS
            while time.perf_counter() < end:
                bare.steps()
                steps += STEPS * NUM_ENVS
            counts.put((together, turn, steps))


def process_gain(name: str, rounds: int, num_processes: int) -> float:
    """Steps that several processes of MuJoCo alone take, over those of one in the same time."""
    context = multiprocessing.get_context("spawn")
    barrier, counts = context.Barrier(num_processes), context.Queue()
    workers = [
        context.Process(target=step_in_turns, args=(name, rank, rounds, barrier, counts))
        for rank in range(num_processes)
    ]
    for worker in workers:
        worker.start()
    taken = np.zeros((2, rounds))
    for _ in range(rounds * (1 + num_processes)):
        together, turn, steps = counts.get()
        taken[int(together), turn] += steps
    for worker in workers:
        worker.join()
    return float(np.median(taken[1] / taken[0]))


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
        "| task | bare | ours | with resets | share of bare | one env | share of bare "
        "| x peer, with resets | the same at bare's speed beside the peer |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name in arguments.tasks:
        (batch, single, bare, led, reset), shares = measure(name, arguments.repeats)
        whole = HORIZON / (HORIZON * batch + reset)
        peer = PEER.get(name)
        versus = " |"
        if peer:
            times, then = (1.0 / batch / peer[0], whole / peer[1]), peer[2] * bare
            versus = f"{times[0]:.1f}, {times[1]:.1f} | {times[0] * then:.1f}, {times[1] * then:.1f}"
        print(
            f"| {name} | {1 / bare:,.0f} | {1 / batch:,.0f} | {whole:,.0f} | {shares[0]:.2f} "
            f"| {1 / single:,.0f} | {shares[1]:.2f} | {versus} |",
            flush=True,
        )
        if SAFETY_TASKS[name].gremlins.number:
            print(f"| {name}, led | {1 / led:,.0f} | | | {shares[2]:.2f} | | | | |")
        if arguments.threads:
            few, many = (
                thread_gains(name, number, arguments.repeats, arguments.threads)
                for number in (NUM_ENVS, MANY_ENVS)
            )
            apart = process_gain(name, ROUNDS, arguments.threads)
            print(
                f"  {name}: {arguments.threads} threads: {few[0]:.2f}x; MuJoCo alone: {few[1]:.2f}x, "
                f"in {arguments.threads} processes: {apart:.2f}x; "
                f"N = {MANY_ENVS}: {many[0]:.2f}x; MuJoCo alone: {many[1]:.2f}x",
                flush=True,
            )


if __name__ == "__main__":
    main()
