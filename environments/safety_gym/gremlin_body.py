"""The gremlins in a compiled step: which of them is simulated as a body, and where the others are.

See ``recrl.environments.safety_gym.gremlins`` for f(t) and the reasons.
"""

from __future__ import annotations

import math
from typing import Any

from recrl.environments.safety_gym.step_records import (
    GREMLINS,
    NO_GREMLIN,
    addresses_at,
    bytes_at,
    doubles_at,
    field,
    robot_place,
)
from recrl.environments.simulation.machine_code import compiled


@compiled
def course_step(task: Any, environment: Any) -> int:
    """Return the index into f(t); a caller may go on after the end of an episode."""
    at: int = min(environment.steps, task.course_steps - 1)
    return at


@compiled
def place_gremlins(task: Any, environment: Any, qpos: Any) -> None:
    """Place the gremlins at f(t) from the centre of their circles; the simulated one is where its body is."""
    course, at = doubles_at(task.course_positions, 3 * task.course_steps), 3 * course_step(task, environment)
    for gremlin in range(task.stop[GREMLINS] - task.start[GREMLINS]):
        point = environment.points[task.start[GREMLINS] + gremlin]
        if gremlin == environment.embodied:
            point[0], point[1] = qpos[task.gremlin_qpos], qpos[task.gremlin_qpos + 1]
        else:
            point[0] = environment.circles[gremlin, 0] + course[at]
            point[1] = environment.circles[gremlin, 1] + course[at + 1]


@compiled
def nearest_gremlin(task: Any, environment: Any, data: int) -> int:
    """Return the gremlin that the robot may meet next, or NO_GREMLIN."""
    robot = robot_place(task, data)
    nearest, least = NO_GREMLIN, math.inf
    for gremlin in range(task.stop[GREMLINS] - task.start[GREMLINS]):
        place = environment.points[task.start[GREMLINS] + gremlin]
        apart = math.hypot(place[0] - robot[0], place[1] - robot[1])
        if apart < least:
            nearest, least = gremlin, apart
    return nearest if least <= task.gremlin_alert else NO_GREMLIN


@compiled
def replaceable(task: Any, environment: Any, data: int) -> bool:
    """Whether the simulated gremlin, if any, may be released: it is untouched and on its course."""
    if environment.embodied < 0:
        return True
    if environment.touching[task.first_body[GREMLINS]]:
        return False
    course = doubles_at(task.course_positions, 3 * task.course_steps)[3 * course_step(task, environment) :]
    circle = environment.circles[environment.embodied]
    place = field(data, task.qpos, task.nq)[task.gremlin_qpos :]
    x, y = place[0] - course[0] - circle[0], place[1] - course[1] - circle[1]
    z = place[2] - course[2]
    near: bool = x * x + y * y + z * z < task.gremlin_on_course * task.gremlin_on_course
    return near


@compiled
def make_body(task: Any, environment: Any, data: int, gremlin: int) -> None:
    """Make this gremlin the body. With NO_GREMLIN the body hovers untied at a place without objects."""
    environment.embodied = gremlin
    place = field(data, task.qpos, task.nq)[task.gremlin_qpos :]
    velocity = field(data, task.qvel, task.nv)[task.gremlin_qvel :]
    lift = field(data, task.qfrc_applied, task.nv)[task.gremlin_qvel :]
    bytes_at(addresses_at(data + task.eq_active, 1)[0], 1)[0] = gremlin >= 0
    if gremlin < 0:
        for axis in range(3):
            place[axis] = task.gremlin_idle_place[axis]
        for axis in range(6):
            velocity[axis] = 0.0
        lift[2] = task.gremlin_weight
        return
    lift[2] = 0.0
    positions = doubles_at(task.course_positions, 3 * task.course_steps)
    velocities = doubles_at(task.course_velocities, 6 * task.course_steps)
    at = course_step(task, environment)
    for axis in range(3):
        place[axis] = positions[3 * at + axis]
    for axis in range(6):
        velocity[axis] = velocities[6 * at + axis]
    place[0] += environment.circles[gremlin, 0]
    place[1] += environment.circles[gremlin, 1]
    half = environment.gremlin_yaws[gremlin] / 2.0
    lead = field(data, task.mocap_quat, 4 * task.nmocap)[4 * task.gremlin_lead :]
    for quaternion in (place[3:], lead):
        quaternion[0], quaternion[3] = math.cos(half), math.sin(half)
        quaternion[1] = quaternion[2] = 0.0


@compiled
def lead_gremlin(task: Any, environment: Any, data: int, substep: int) -> None:
    """Move the mocap body that leads the gremlin: 0.35 (sin t, cos t) from the centre of its circle."""
    lead = field(data, task.mocap_pos, 3 * task.nmocap)[3 * task.gremlin_lead :]
    time = task.timestep * (environment.steps * task.substeps + substep)
    lead[0] = environment.circles[environment.embodied, 0] + task.gremlin_travel * math.sin(time)
    lead[1] = environment.circles[environment.embodied, 1] + task.gremlin_travel * math.cos(time)
