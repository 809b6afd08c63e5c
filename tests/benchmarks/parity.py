"""Are our environments Safety Gym's? A check against recorded episodes of another implementation.

python tests/benchmarks/parity.py [FOLDER]     default: tests/parity

Prints two lines an episode; exits with 1 if anything differs by more than 1e-5, or any cost or goal differs,
or the robot moves differently in half of the steps.

A recording holds, for every step of an episode, the state of the physics, what was observed, the reward,
the cost terms and the goal. Here our environments are put into the recorded states. What they then observe,
earn and pay must be equal but for rounding, or something is defined differently. Then they take the recorded
action, for one step. Where the robot ends is compared by the median over all steps. In some steps contacts
amplify rounding, and solvers differ.

The recordings' format is described in ``tests/parity/README.md``.

Notation: T steps in an episode, B environments, one for each state of a chunk of an episode.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.compiled_step import perceive
from recrl.environments.safety_gym.gremlins import gremlin_course
from recrl.environments.safety_gym.safety_gym_batch import SafetyGymBatch
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS, SafetyTask

CHUNK = 128
TOLERANCE = 1e-5
PRECISE, ROUNDED = (1e-12, 1e-10), (1e-6, 1e-5)
"""Largest median errors of the robot after a step: of its place (metres) and velocities (m/s, rad/s). They
depend on whether the next state was recorded in double or in single precision.
"""
_COMPONENTS = {"push_box_lidar": "box_lidar"}
"""The recordings' names for parts of an observation, where they are not Safety Gym's."""
Integers = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Comparison:
    """How far our environments are from one recorded episode.

    Attributes:
        task: the task's name.
        policy: who acted.
        states: compared, T + 1.
        observation: greatest difference of any observed number.
        reward: greatest difference of a reward.
        costs: for each cost term, and ``cost`` for all together: steps in which our indicator differs.
        costly: for the same, steps in which the recording has a cost.
        goals: steps in which we differ on whether the goal was met.
    """

    task: str
    policy: str
    states: int
    observation: float
    reward: float
    costs: dict[str, int]
    costly: dict[str, int]
    goals: int

    @property
    def equal(self) -> bool:
        """Whether everything agrees within 1e-5, and costs and goals in every step."""
        agrees = self.observation <= TOLERANCE and self.reward <= TOLERANCE
        return agrees and not any(self.costs.values()) and not self.goals


@dataclass(frozen=True)
class StepErrors:
    """How far one step from a recorded state ends from the next recorded state, for one episode.

    Attributes:
        place: median error of the robot's horizontal place, the greater of x and y, metres.
        velocity: median of the greatest error of its velocities, m/s and rad/s.
        precise: whether the next states were recorded in double precision.
    """

    place: float
    velocity: float
    precise: bool

    @property
    def equal(self) -> bool:
        """Whether the robot moves as recorded, but for rounding, in at least half of the steps."""
        place, velocity = PRECISE if self.precise else ROUNDED
        return self.place <= place and self.velocity <= velocity


def compare_recording(path: Path) -> list[Comparison]:
    """Compare every episode of one file."""
    task, meta, episodes = _read(path)
    return [_compare_episode(task, meta, arrays, policy) for arrays, policy in episodes]


def compare_steps(path: Path) -> list[StepErrors]:
    """Take one step from every recorded state of the robot, for every episode of one file."""
    task, meta, episodes = _read(path)
    return [_step_errors(task, meta, arrays) for arrays, _ in episodes]


def _read(path: Path) -> tuple[SafetyTask, dict[str, Any], list[tuple[dict[str, Any], str]]]:
    """Return the task of a file, its ``meta``, and each recorded episode with its policy."""
    with np.load(path) as arrays:
        meta = json.loads(str(arrays["meta"]))
        episodes = [
            {name[4:]: arrays[name] for name in arrays.files if name.startswith(f"e{index:02d}_")}
            for index in range(len(meta["lengths"]))
        ]
    recorded = [each for each in zip(episodes, meta["policies"], strict=True) if each[0]]
    return SAFETY_TASKS[meta["robot"] + meta["task"]], meta, recorded


def _step_errors(task: SafetyTask, meta: dict[str, Any], episode: dict[str, Any]) -> StepErrors:
    precise = "qpos_robot64" not in episode  # else only every fifth state, and none is the next of another
    now = np.arange(0, len(episode["reward"]), 1 if precise else 5)
    batch = SafetyGymBatch(task, len(now))
    batch.seed(0)  # for a new goal
    _put_into(batch, meta, episode, at=now, pursuing=now)
    batch.set_actions(np.clip(episode["action"][:, now].T, -1.0, 1.0))
    batch.advance()
    qpos, qvel = _robot_state(task, meta, episode, now + 1)
    places = np.abs(batch.qpos[:, :2] - qpos[:, :2]).max(axis=1)
    velocities = np.abs(batch.qvel[:, : batch.scene.robot_qvel] - qvel).max(axis=1)
    return StepErrors(float(np.median(places)), float(np.median(velocities)), precise)


def _compare_episode(
    task: SafetyTask, meta: dict[str, Any], episode: dict[str, Any], policy: str
) -> Comparison:
    length = len(episode["reward"])
    batch = SafetyGymBatch(task, min(CHUNK, length + 1))
    seen, rewards, terms, met = [], [], [], []
    for start in range(0, length + 1, batch.number):
        now = np.minimum(np.arange(start, start + batch.number), length)
        _put_into(batch, meta, episode, at=now, pursuing=now)
        batch.acceleration[...] = _acceleration(task, meta, episode, now)
        perceive(batch.record, batch.world)
        seen.append(batch.observations())
        before = np.maximum(now - 1, 0)
        _put_into(batch, meta, episode, at=before, pursuing=before)
        last = batch.measured.copy()
        _put_into(batch, meta, episode, at=now, pursuing=before)
        met.append(batch.goal_met.copy())
        rewards.append((last - batch.measured).sum(axis=1) + met[-1])
        terms.append(batch.terms.copy())
    ours = [np.concatenate(parts)[: length + 1] for parts in (seen, rewards, terms, met)]
    mismatches, costly = _cost_mismatches(task, meta, episode, ours[2][1:])
    return Comparison(
        task=task.name,
        policy=policy,
        states=length + 1,
        observation=_observation_difference(task, meta, episode, ours[0]),
        reward=float(np.abs(ours[1][1:] - episode["reward"]).max()),
        costs=mismatches,
        costly=costly,
        goals=int((ours[3][1:] != episode["goal_met"].astype(bool)).sum()),
    )


def _put_into(
    batch: SafetyGymBatch,
    meta: dict[str, Any],
    episode: dict[str, Any],
    *,
    at: Integers,
    pursuing: Integers,
) -> None:
    """Put environment b into the state ``at[b]``, with the goal and button timer of ``pursuing[b]``."""
    scene, task = batch.scene, batch.task
    batch.simulations.reset(np.arange(batch.number))
    qpos, qvel = _robot_state(task, meta, episode, at)
    batch.qpos[:, : scene.robot_qpos], batch.qvel[:, : scene.robot_qvel] = qpos, qvel
    if "goal_pos" in episode:
        goal = batch.group["goal"].start
        batch.points[:, goal] = episode["goal_pos"][:2, pursuing].T
    for index in range(task.vases.number):
        qpos, qvel = _body(meta, episode, f"vase{index}", at)
        batch.qpos[:, scene.vase_qpos[index] : scene.vase_qpos[index] + 7] = qpos
        batch.qvel[:, scene.vase_qvel[index] : scene.vase_qvel[index] + 6] = qvel
    if task.box.number:
        qpos, qvel = _body(meta, episode, "push_box", at)
        batch.qpos[:, scene.box_qpos :], batch.qvel[:, scene.robot_qvel :] = qpos, qvel
    for kind, mocap in (("hazard", ()), ("button", scene.button_mocap), ("pillar", scene.pillar_mocap)):
        places = _static_places(meta, episode, kind)
        if len(places) and f"{kind}s" in batch.group:
            batch.points[:, batch.group[f"{kind}s"]] = places
        if len(mocap):
            batch.mocap_pos[:, list(mocap), :2] = places
    if task.gremlins.number:
        _put_gremlins(batch, meta, episode, at)
    if task.goal == "Button":
        batch.goal_button[:] = episode["goal_button"][pursuing]
        batch.button_timer[:] = episode["buttons_timer"][pursuing]
    batch.simulations.forward(np.arange(batch.number))
    batch.refresh()


def _robot_state(
    task: SafetyTask, meta: dict[str, Any], episode: dict[str, Any], at: Integers
) -> tuple[Floats, Floats]:
    """Coordinates and velocities of the robot, [B, ...], in full precision where they were recorded so."""
    qpos = episode["qpos_robot"][:, at].T.astype(np.float64)
    qvel = episode["qvel_robot"][:, at].T.astype(np.float64)
    if "qpos_robot64" in episode:
        precise = at % 5 == 0
        qpos[precise] = episode["qpos_robot64"][:, at[precise] // 5].T
        qvel[precise] = episode["qvel_robot64"][:, at[precise] // 5].T
    if task.robot == "Point":
        # The recordings' slides run along the axes in which the robot began, ours along the world's.
        pose = episode["robot_pose"][:, at].T
        yaw = np.arctan2(pose[:, 6], pose[:, 3])
        qvel = _turned(qvel, yaw - qpos[:, 2])
        qpos = np.column_stack((pose[:, :2], yaw))
    return qpos, qvel


def _acceleration(task: SafetyTask, meta: dict[str, Any], episode: dict[str, Any], at: Integers) -> Floats:
    """The robot's recorded acceleration, [B, 3]; zero where it was not recorded."""
    every = meta["obs_every"]
    acceleration = np.zeros((len(at), meta["nv_robot"]))
    recorded = at % every == 0
    acceleration[recorded] = episode["qacc_robot"][:, at[recorded] // every].T
    if task.robot == "Point":
        pose = episode["robot_pose"][:, at].T
        yaw = np.arctan2(pose[:, 6], pose[:, 3])
        acceleration = _turned(acceleration, yaw - episode["qpos_robot"][2, at])
        acceleration[:, 2] = 0.0  # of its yaw
    return acceleration[:, :3]


def _turned(vectors: Floats, angle: Floats) -> Floats:
    """Turn the first two numbers of each vector, [B, m], by an angle [B] about the vertical."""
    turned = vectors.copy()
    turned[:, 0] = np.cos(angle) * vectors[:, 0] - np.sin(angle) * vectors[:, 1]
    turned[:, 1] = np.sin(angle) * vectors[:, 0] + np.cos(angle) * vectors[:, 1]
    return turned


def _body(meta: dict[str, Any], episode: dict[str, Any], name: str, at: Integers) -> tuple[Floats, Floats]:
    """Coordinates [B, 7] and velocities [B, 6] of a free body."""
    coordinate = meta["qpos_adr"][name] - meta["nq_robot"]
    velocity = meta["qvel_adr"][name] - meta["nv_robot"]
    return (
        episode["qpos_obj"][coordinate : coordinate + 7, at].T.astype(np.float64),
        episode["qvel_obj"][velocity : velocity + 6, at].T.astype(np.float64),
    )


def _put_gremlins(batch: SafetyGymBatch, meta: dict[str, Any], episode: dict[str, Any], at: Integers) -> None:
    """Make the gremlin nearest the robot the body; all are where they were recorded, even off course."""
    scene = batch.scene
    names = [f"gremlin{index}obj" for index in range(batch.task.gremlins.number)]
    bodies = [_body(meta, episode, name, at) for name in names]
    coordinates, velocities = (np.stack(parts) for parts in zip(*bodies, strict=True))
    robot = batch.qpos[:, :2]
    nearest = np.square(coordinates[:, :, :2] - robot).sum(axis=2).argmin(axis=0)
    everyone = np.arange(batch.number)
    qpos, qvel = scene.gremlin_qpos, scene.gremlin_qvel
    batch.qpos[:, qpos : qpos + 7] = coordinates[nearest, everyone]
    batch.qvel[:, qvel : qvel + 6] = velocities[nearest, everyone]
    batch.embodied[:], batch.steps[:] = nearest, at
    course = gremlin_course(batch.task).positions[at, None, :2]
    batch.circles[...] = coordinates[:, :, :2].transpose(1, 0, 2) - course


def _static_places(meta: dict[str, Any], episode: dict[str, Any], kind: str) -> Floats:
    names = meta["static_names"]
    rows = [index for index, name in enumerate(names) if name.startswith(kind)]
    places: Floats = np.asarray(episode["static_pos"])[rows, :2] if rows else np.zeros((0, 2))
    return places


def _observation_difference(
    task: SafetyTask, meta: dict[str, Any], episode: dict[str, Any], ours: npt.NDArray[np.float32]
) -> float:
    """Greatest difference, part by part: the recordings have them in another order."""
    every = meta["obs_every"]
    recorded, start, greatest = episode["obs"].T, 0, 0.0
    for name, size in meta["obs_layout"]:
        theirs = recorded[:, start : start + size]
        mine = ours[::every, task.where(_COMPONENTS.get(name, name))]
        greatest = max(greatest, float(np.abs(mine - theirs).max()))
        start += size
    if start != task.observation_size:
        raise ValueError(
            f"{task.name}: recorded observations have {start} numbers, ours {task.observation_size}"
        )
    return greatest


def _cost_mismatches(
    task: SafetyTask, meta: dict[str, Any], episode: dict[str, Any], ours: Floats
) -> tuple[dict[str, int], dict[str, int]]:
    recorded = {
        name.removeprefix("cost_"): np.asarray(np.nan_to_num(row) > 0)
        for name, row in zip(meta["raw_cost_names"], episode["raw_cost"], strict=True)
    }
    theirs = {term: recorded[term] for term in task.cost_terms} | {"cost": episode["cost"] > 0}
    mine = {term: ours[:, column] > 0 for column, term in enumerate(task.cost_terms)}
    mine["cost"] = np.asarray(ours.any(axis=1))
    mismatches = {name: int((mine[name] != theirs[name]).sum()) for name in theirs}
    return mismatches, {name: int(theirs[name].sum()) for name in theirs}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path(__file__).parents[1] / "parity")
    files = sorted(parser.parse_args().folder.glob("*.npz"))
    if not files:
        print("no recordings (*.npz) in that folder")
        return 1
    print(
        f"{'task':14}{'policy':10}{'states':>7}{'observation':>13}{'reward':>10}  goals and costs that differ"
    )
    compared = [comparison for path in files for comparison in compare_recording(path)]
    for one in compared:
        differing = {"goals": one.goals, **one.costs}
        text = ", ".join(f"{name} {count}" for name, count in differing.items() if count) or "none"
        costly = ", ".join(f"{name} {count}" for name, count in one.costly.items())
        print(
            f"{one.task:14}{one.policy:10}{one.states:7}{one.observation:13.1e}{one.reward:10.1e}"
            f"  {text} (of {costly})"
        )
    states, unequal = sum(one.states for one in compared), sum(not one.equal for one in compared)
    print(f"{len(compared)} episodes, {states} states: {unequal} differ (tolerance {TOLERANCE:g})")
    steps = [(path.stem.removeprefix("peer_"), errors) for path in files for errors in compare_steps(path)]
    for name, errors in steps:
        verdict = "" if errors.equal else "  differs"
        print(f"{name:14}one step: place {errors.place:.1e} m, velocity {errors.velocity:.1e}{verdict}")
    return int(unequal > 0 or not all(errors.equal for _, errors in steps))


if __name__ == "__main__":
    sys.exit(main())
