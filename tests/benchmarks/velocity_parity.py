"""Are our robots safety-gymnasium's? A check against recorded episodes of safety-gymnasium on MuJoCo 2.3.3.

python tests/benchmarks/velocity_parity.py [FOLDER]     default: tests/parity_velocity

Exits with 1 if anything differs but what Humanoid's contact forces decide: those are in the last two
columns, each as the greatest difference and the number of states in which it exceeds the tolerance.
Differences of observations are relative to max(1, |recorded|).

A recording holds coordinates and velocities before and after every step, the action, what was observed, the
reward, the cost and whether the episode ended. Here our robots are put into the recorded states, and say what
they observe, earn and pay: equal but for rounding, or something is defined differently.

Ant's and Humanoid's rewards, and what Humanoid observes of its bodies, come from a moment that is not
recorded: the last one at which MuJoCo computed positions, which in its Runge-Kutta steps is the last of
four stages. ``last_stage`` goes there from the recorded state, with the Runge-Kutta steps of MuJoCo 2:
those of MuJoCo 4 treat orientations otherwise. Humanoid's contact forces, and hence velocities in that
moment, are what an iterative solver found in at most 50 iterations, and MuJoCo 4's solver finds others:
they agree only approximately where something is in contact.

Notation: T steps in an episode, B robots, one for each recorded state.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.velocity.task_definitions import VELOCITY_TASKS, VelocityTask
from recrl.environments.velocity.velocity_batch import VelocityBatch

TOLERANCE = 1e-5
STAGES = (0.5, 0.5, 1.0)
"""Where the second to fourth stage of a Runge-Kutta step begin, in steps after its start."""


@dataclass(frozen=True)
class VelocityComparison:
    """How far our robots are from one recorded episode.

    Differences of observations are relative to max(1, |recorded|): contact forces are thousands of newtons.

    Attributes:
        task: the task's name.
        states: compared, T + 1.
        observation: greatest difference of any number but those that contact forces decide.
        velocity: of the bodies' velocities, in every state, [T + 1]; zeros where they are not observed.
        force: likewise of the contact forces on bodies.
        reward: greatest difference of a reward.
        costs: steps in which our cost differs.
        costly: steps in which the recording has a cost.
        terminations: steps in which we differ on whether the episode ended.
    """

    task: str
    states: int
    observation: float
    velocity: Floats
    force: Floats
    reward: float
    costs: int
    costly: int
    terminations: int

    @property
    def equal(self) -> bool:
        """Whether everything but what contact forces decide agrees within 1e-5."""
        agrees = self.observation <= TOLERANCE and self.reward <= TOLERANCE
        return agrees and not self.costs and not self.terminations


def compare_velocity_recording(path: Path) -> list[VelocityComparison]:
    """Compare every episode of one file.

    Raises:
        ValueError: time step, frame skip, threshold or bounds of the actions are not ours.
    """
    with np.load(path) as arrays:
        meta = json.loads(str(arrays["meta"]))
        task = VELOCITY_TASKS[f"Safety{meta['task']}Velocity"]
        _check_numbers(task, meta)
        episodes = [
            {name[4:]: arrays[name] for name in arrays.files if name.startswith(f"e{index:02d}_")}
            for index in range(len(meta["lengths"]))
        ]
    return [_compare_episode(task, episode) for episode in episodes]


def last_stage(model: mujoco.MjModel, data: mujoco.MjData, frame_skip: int) -> tuple[Floats, Floats, Floats]:
    """Take Runge-Kutta steps as MuJoCo 2 does.

    A step from (q, v), with accelerations a_i at stage i: q_i = q + c_i h v_(i-1), v_i = v + c_i h a_(i-1);
    at its end q + h (v_1 + 2 v_2 + 2 v_3 + v_4) / 6, and likewise v. MuJoCo 4 adds a correction to
    orientations.

    Args:
        model: of the robot.
        data: its state, which is changed; the solver begins where it ended in the stage before.
        frame_skip: steps.

    Returns:
        coordinates, velocities and the solver's beginning in the last stage of the last step.
    """
    h = model.opt.timestep
    for _ in range(frame_skip):
        q, v = data.qpos.copy(), data.qvel.copy()
        velocities, accelerations = [v], [_accelerations(model, data)]
        for c in STAGES:
            data.qpos[:] = q
            mujoco.mj_integratePos(model, data.qpos, c * velocities[-1], h)
            data.qvel[:] = v + h * c * accelerations[-1]
            velocities.append(data.qvel.copy())
            last = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
            accelerations.append(_accelerations(model, data))
        data.qpos[:] = q
        mujoco.mj_integratePos(model, data.qpos, _weighted(velocities), h)
        data.qvel[:] = v + h * _weighted(accelerations)
    return last


def _weighted(stages: list[Floats]) -> Floats:
    first, second, third, fourth = stages
    return np.asarray((first + 2.0 * second + 2.0 * third + fourth) / 6.0)


def _accelerations(model: mujoco.MjModel, data: mujoco.MjData) -> Floats:
    mujoco.mj_forward(model, data)
    data.qacc_warmstart[:] = data.qacc
    found: Floats = data.qacc.copy()
    return found


def _check_numbers(task: VelocityTask, meta: dict[str, Any]) -> None:
    batch = VelocityBatch(task, 1)
    ours = (task.threshold, task.frame_skip, batch.model.opt.timestep, batch.seconds, batch.observed)
    theirs = (*(meta[name] for name in ("threshold", "frame_skip", "timestep", "dt")), meta["obs"][0])
    bounds = {-batch.bound, batch.bound}
    if ours != theirs or {*meta["action_low"], *meta["action_high"]} != bounds:
        raise ValueError(f"{task.name}: the recording has {theirs}, we have {ours}, actions within {bounds}")


def _compare_episode(task: VelocityTask, episode: dict[str, npt.NDArray[Any]]) -> VelocityComparison:
    batch = VelocityBatch(task, len(episode["qpos"]))
    places = _see_bodies(batch, episode)
    batch.qpos[...], batch.qvel[...] = episode["qpos"], episode["qvel"]
    passed = np.vstack((np.zeros((1, task.axes)), np.diff(places, axis=0) / batch.seconds))
    actions = np.vstack((np.zeros_like(episode["action"][:1]), episode["action"]))
    rewards, _, costs = batch.rewards_and_costs(passed, actions)
    # In single precision, as ours are; contact forces are compared relatively.
    recorded = episode["obs"].astype(np.float32).astype(np.float64)
    apart = np.abs(batch.observations() - recorded) / np.maximum(1.0, np.abs(recorded))
    bodies = batch.model.nbody
    forces, velocities = apart[:, -6 * bodies :], apart[:, -12 * bodies - batch.model.nv : -6 * bodies]
    others = apart[:, : -12 * bodies - batch.model.nv] if task.observes_bodies else apart
    decided = task.observes_bodies
    return VelocityComparison(
        task=task.name,
        states=batch.number,
        observation=float(others.max()),
        velocity=velocities.max(axis=1) if decided else np.zeros(batch.number),
        force=forces.max(axis=1) if decided else np.zeros(batch.number),
        reward=float(np.abs(rewards[1:] - episode["reward"]).max()),
        costs=int((costs[1:] != episode["cost"]).sum()),
        costly=int((episode["cost"] > 0).sum()),
        terminations=int((batch.fallen()[1:] != episode["terminated"]).sum()),
    )


def _see_bodies(batch: VelocityBatch, episode: dict[str, npt.NDArray[Any]]) -> Floats:
    """Let robot t know of its bodies what was known after step t - 1, and return where each was measured."""
    state, task = mujoco.mjtState, batch.task
    batch.qpos[...], batch.qvel[...] = episode["qpos"], episode["qvel"]
    if not batch.bodies:
        return batch.measured()
    data = mujoco.MjData(batch.model)
    data.qpos[:], data.qvel[:] = episode["qpos"][0], episode["qvel"][0]
    _accelerations(batch.model, data)
    controls = batch.simulations.state(state.mjSTATE_CTRL, (batch.model.nu,))
    beginnings = batch.simulations.state(state.mjSTATE_WARMSTART, (batch.model.nv,))
    for step, action in enumerate(episode["action"]):
        data.qpos[:], data.qvel[:] = episode["qpos"][step], episode["qvel"][step]
        data.ctrl[:] = controls[step + 1] = action
        batch.qpos[step + 1], batch.qvel[step + 1], beginnings[step + 1] = last_stage(
            batch.model, data, task.frame_skip
        )
    batch.simulations.forward(None)
    if task.observes_bodies:
        batch.simulations.compute_body_forces()
        batch.bodies["cfrc_ext"][0] = 0.0
    return batch.measured()


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[1] / "parity_velocity")
    files = sorted(parser.parse_args().folder.glob("*.npz"))
    if not files:
        print("no recordings (*.npz) in that folder")
        return 1
    print(
        "| task | states | observation | reward | costs | of | terminations "
        "| body velocities | contact forces |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    unequal = 0
    for path in files:
        episodes = compare_velocity_recording(path)
        unequal += sum(not one.equal for one in episodes)
        decided = [np.concatenate([getattr(one, name) for one in episodes]) for name in ("velocity", "force")]
        shown = " | ".join(f"{found.max():.1e} in {(found > TOLERANCE).sum()}" for found in decided)
        print(
            f"| {episodes[0].task} | {sum(one.states for one in episodes)} "
            f"| {max(one.observation for one in episodes):.1e} | {max(one.reward for one in episodes):.1e} "
            f"| {sum(one.costs for one in episodes)} | {sum(one.costly for one in episodes)} "
            f"| {sum(one.terminations for one in episodes)} | {shown} |"
        )
    print(f"\n{unequal} episodes differ (tolerance {TOLERANCE:g})")
    return int(unequal > 0)


if __name__ == "__main__":
    sys.exit(main())
