"""How fast the velocity tasks are, as a fraction of what MuJoCo alone would need.

OMP_NUM_THREADS=1 python tests/benchmarks/bench_velocity.py [--tasks SafetyAntVelocity ...] [--repeats 200]
    [--machine 1.2]

For every task 16 environments under random actions, resets included, against the same 16 simulations
stepped by ``mj_step(model, data, frame_skip)`` alone in a Python loop ("bare"), which has no resets,
rewards or observations; and against what Gymnasium's environments of version 4 do in a step, without their
wrappers and resets ("Gymnasium"). They take turns of 80 steps on one core, in one run, so that a noisy
machine hurts all alike. In each turn the others begin in the states in which ours began, and do the same
actions; each takes one step before its time counts. Times are CPU seconds of this process, lower quartiles
over the turns; a fraction is the median over the turns of neighbouring times.

The peer is safety-gymnasium 1.0.0 with resets, steps per CPU second on the machine of the recordings.
``--machine`` says how many times faster bare MuJoCo is here than there (``bench_safety_gym.py``: CarGoal2's
bare speed over 4,961): the last column is against the peer's speed times that.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import mujoco
import numpy as np

from recrl.environments.cmdp import Floats
from recrl.environments.velocity.task_definitions import VELOCITY_TASKS
from recrl.environments.velocity.velocity_batch import VelocityBatch
from recrl.environments.velocity.velocity_environments import VelocityVectorEnv

NUM_ENVS = 16
STEPS = 5
"""Steps of every environment in a turn."""
PEER = {
    "SafetyAntVelocity": 4017,
    "SafetyHalfCheetahVelocity": 19131,
    "SafetyHopperVelocity": 10065,
    "SafetyHumanoidVelocity": 3630,
    "SafetySwimmerVelocity": 20527,
    "SafetyWalker2dVelocity": 8804,
}


class Bare:
    """Simulations stepped by MuJoCo alone."""

    def __init__(self, batch: VelocityBatch) -> None:
        self.batch, self.task, self.model = batch, batch.task, batch.model
        self.datas = [mujoco.MjData(self.model) for _ in range(batch.number)]

    def begin(self) -> None:
        """Begin where the environments are."""
        state = mujoco.mjtState.mjSTATE_INTEGRATION.value
        for data, row in zip(self.datas, self.batch.simulations.rows, strict=True):
            mujoco.mj_setState(self.model, data, row, state)

    def steps(self, actions: Floats) -> None:
        """Take some steps, [steps, B, nu]."""
        for controls in actions:
            for data, control in zip(self.datas, controls, strict=True):
                data.ctrl[:] = control
                mujoco.mj_step(self.model, data, self.task.frame_skip)


class Gymnasium(Bare):
    """What an environment of Gymnasium does in a step, one after the other."""

    def steps(self, actions: Floats) -> None:
        """Take some steps, [steps, B, nu]."""
        for controls in actions:
            for data, control in zip(self.datas, controls, strict=True):
                self.step(data, control)

    def step(self, data: mujoco.MjData, action: Floats) -> tuple[Floats, float, float, bool]:
        """Observation, reward, cost and termination of a step."""
        task, before = self.task, self.place(data)
        data.ctrl[:] = action
        mujoco.mj_step(self.model, data, task.frame_skip)
        mujoco.mj_rnePostConstraint(self.model, data)
        passed = (self.place(data) - before) / self.batch.seconds
        velocity = passed[0] if task.axes == 1 else np.linalg.norm(passed[:2])
        position, speeds = data.qpos.copy(), data.qvel.copy()
        if task.velocity_bound < np.inf:
            speeds = np.clip(speeds, -task.velocity_bound, task.velocity_bound)
        parts = [position[task.hidden :], speeds]
        if task.observes_bodies:
            parts += [data.cinert.ravel(), data.cvel.ravel(), data.qfrc_actuator, data.cfrc_ext.ravel()]
        fallen = task.healthy is not None and not task.healthy(position[None], speeds[None])[0]
        reward = task.forward_weight * passed[0] + task.healthy_reward
        reward -= task.control_weight * np.sum(np.square(action))
        return np.concatenate(parts), float(reward), float(velocity > task.threshold), fallen

    def place(self, data: mujoco.MjData) -> Floats:
        """Where velocities are measured."""
        if self.task.measured == "mass":
            mass = self.model.body_mass
            return np.asarray(mass @ data.xipos / mass.sum())
        return np.array(data.xpos[1] if self.task.measured == "torso" else data.qpos[:2])


def timed(work: Callable[[Floats], object], actions: Floats) -> float:
    start = time.process_time()
    work(actions)
    return time.process_time() - start


def measure(name: str, repeats: int) -> tuple[Floats, Floats, float]:
    """CPU seconds of a step (ours with resets, bare, Gymnasium), the latter two over ours, resets a step."""
    batch = VelocityVectorEnv(name, NUM_ENVS)
    batch.reset(seed=0)
    rivals = [Bare(batch.batch), Gymnasium(batch.batch)]
    generator, bound, ended = np.random.default_rng(0), batch.batch.bound, 0

    def ours(actions: Floats) -> None:
        nonlocal ended
        for each in actions:
            _, _, terminated, truncated, _ = batch.step(each)
            ended += int(terminated.sum() + truncated.sum())

    turns = [ours, *(rival.steps for rival in rivals)]
    times = np.zeros((3, repeats))
    for repeat in range(-10, repeats):
        actions = generator.uniform(-bound, bound, (1 + STEPS, NUM_ENVS, batch.batch.model.nu))
        for rival in rivals:
            rival.begin()
        for row, turn in enumerate(turns):
            turn(actions[:1])  # what a turn finds in the cache is not what the turn before left there
            elapsed = timed(turn, actions[1:])
            if repeat >= 0:
                times[row, repeat] = elapsed
    times /= STEPS * NUM_ENVS
    fractions = np.median(times[1:] / times[0], axis=1)
    return np.quantile(times, 0.25, axis=1), fractions, ended / ((1 + STEPS) * NUM_ENVS * (repeats + 10))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=list(VELOCITY_TASKS), choices=list(VELOCITY_TASKS))
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--machine", type=float, default=1.0, help="bare MuJoCo here over there")
    arguments = parser.parse_args()
    print("environment steps per CPU second, N = 16, resets included\n")
    print(
        "| task | bare | ours | fraction of bare | Gymnasium | x Gymnasium | steps a reset "
        "| peer | x peer | x peer, scaled |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in arguments.tasks:
        (ours, bare, theirs), fractions, resets = measure(name, arguments.repeats)
        versus = 1.0 / ours / PEER[name]
        print(
            f"| {name} | {1 / bare:,.0f} | {1 / ours:,.0f} | {fractions[0]:.2f} | {1 / theirs:,.0f} "
            f"| {fractions[1]:.2f} | {f'{1 / resets:,.0f}' if resets else 'none'} "
            f"| {PEER[name]:,} | {versus:.2f} | {versus / arguments.machine:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
