"""The record of a task for compiled code, and the memory that compiled code writes.

The record is declared in ``recrl.environments.safety_gym.step_records``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.gremlins import ALERT, IDLE_PLACE, ON_COURSE, Course, gremlin_course
from recrl.environments.safety_gym.layout import keepouts
from recrl.environments.safety_gym.scene import Scene
from recrl.environments.safety_gym.step_records import (
    ENVIRONMENT,
    KINDS,
    MAX_BODIES,
    MAX_POINTS,
    OUTCOME,
    SENSORS,
    TASK,
    TERMS,
)
from recrl.environments.safety_gym.task_definitions import (
    GOAL_HEIGHT,
    GRAVITY,
    GREMLIN_TRAVEL,
    LIDAR_BINS,
    LIDAR_RANGE,
    MAGNETIC_FIELD,
    REWARD_BOUND,
    SUBSTEPS,
    VASE_SPEED,
    SafetyTask,
)

_NONE = slice(0, 0)


def places_of_objects(task: SafetyTask) -> dict[str, slice]:
    """Return for each kind that the lidar sees its range among all P objects, in the order of ``lidars``."""
    counts = {kind: number for kind, (number, _) in keepouts(task).items()} | {"goal": 1}
    ends = np.cumsum([counts[kind] for kind in task.lidars]).tolist()
    starts = [0, *ends[:-1]]
    return {kind: slice(start, end) for kind, start, end in zip(task.lidars, starts, ends, strict=True)}


@dataclass(frozen=True)
class Memory:
    """Memory that compiled code reads and writes.

    Attributes:
        environments: records ``ENVIRONMENT``, [B].
        outcomes: records ``OUTCOME``, [B].
        results: of them rewards, costs and the indicators of each cost term, [2 + terms, B].
        flags: of them ``FLAGS``, [len(FLAGS), B].
        observations: [B, size].
        course: motion of gremlins; empty if there are none.
    """

    environments: npt.NDArray[Any]
    outcomes: npt.NDArray[Any]
    results: Floats
    flags: npt.NDArray[np.bool_]
    observations: npt.NDArray[np.float32]
    course: Course


def allocate(scene: Scene, number: int) -> Memory:
    """Allocate memory for ``number`` environments of a scene."""
    none = Course(np.zeros((0, 3)), np.zeros((0, 6)))
    outcomes = np.zeros(number, OUTCOME)
    return Memory(
        environments=np.zeros(number, ENVIRONMENT),
        outcomes=outcomes,
        results=outcomes["numbers"].T[: 2 + len(scene.task.cost_terms)],
        flags=outcomes["flags"].view(np.bool_).T,
        observations=np.zeros((number, scene.task.observation_size), np.float32),
        course=gremlin_course(scene.task) if scene.task.gremlins.number else none,
    )


def task_record(scene: Scene, horizon: int) -> Any:
    """Return the record ``TASK`` of a scene."""
    one = np.zeros(1, TASK)[0]
    one["horizon"] = horizon
    _describe_model(one, scene)
    _describe_task(one, scene)
    if scene.task.gremlins.number:
        _describe_gremlins(one, scene)
    return one


def _describe_model(one: Any, scene: Scene) -> None:
    model = scene.model
    if model.nbody > MAX_BODIES:
        raise ValueError(f"{scene.task.name}: at most {MAX_BODIES} bodies are possible")
    one["timestep"], one["substeps"] = model.opt.timestep, SUBSTEPS
    one["is_car"] = scene.task.robot == "Car"
    one["touchable"][: model.nsensor] = model.sensor_refid
    vases = len(scene.vase_qpos)  # contiguous, after the robot
    assert scene.vase_qpos == tuple(range(scene.robot_qpos, scene.robot_qpos + 7 * vases, 7))
    assert scene.vase_qvel == tuple(range(scene.robot_qvel, scene.robot_qvel + 6 * vases, 6))
    one["vase_qpos"], one["vase_qvel"] = scene.robot_qpos, scene.robot_qvel
    one["box_qpos"] = scene.box_qpos


def _describe_task(one: Any, scene: Scene) -> None:
    task, places = scene.task, places_of_objects(scene.task)
    if max(place.stop for place in places.values()) > MAX_POINTS:
        raise ValueError(f"{task.name}: at most {MAX_POINTS} objects are possible")
    starts = {name: task.where(name).start for name, _ in task.components}
    for index, kind in enumerate(KINDS):
        place, bodies = places.get(kind, _NONE), scene.touchable.get(kind, _NONE)
        one["start"][index], one["stop"][index] = place.start, place.stop
        one["first_body"][index], one["last_body"][index] = bodies.start, bodies.stop
        one["lidar"][index] = starts.get(f"{kind}_lidar", -1)
    one["sensors"] = [starts.get(name, -1) for name in SENSORS]
    one["num_terms"] = len(task.cost_terms)
    one["terms"][: len(task.cost_terms)] = [TERMS.index(term) for term in task.cost_terms]
    one["is_push"], one["is_button"] = task.goal == "Push", task.goal == "Button"
    one["goal_size"], one["goal_height"] = task.target.size, GOAL_HEIGHT
    one["hazard_size"], one["vase_speed"] = task.hazards.size, VASE_SPEED
    one["reward_bound"] = REWARD_BOUND
    one["lidar_bins"], one["lidar_range"] = LIDAR_BINS, LIDAR_RANGE
    one["gravity"], one["magnetic_field"] = GRAVITY, MAGNETIC_FIELD


def _describe_gremlins(one: Any, scene: Scene) -> None:
    model = scene.model
    one["gremlin_qpos"], one["gremlin_lead"] = scene.gremlin_qpos, scene.gremlin_mocap
    one["gremlin_travel"] = GREMLIN_TRAVEL
    one["gremlin_weight"] = -model.body("gremlin").mass[0] * model.opt.gravity[2]
    one["gremlin_alert"] = scene.gremlin_reach + ALERT
    one["gremlin_on_course"], one["gremlin_idle_place"] = ON_COURSE, IDLE_PLACE
