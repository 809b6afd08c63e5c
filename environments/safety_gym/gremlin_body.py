"""The gremlins, compiled: which of them is simulated as a body, and where the others are.

See ``recrl.environments.safety_gym.gremlins`` for f(t) and the reasons.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from recrl.environments.safety_gym.step_records import GREMLINS, NO_GREMLIN
from recrl.environments.simulation.machine_code import compiled, compiled_for_arrays


class Body(NamedTuple):
    """MuJoCo's state of the gremlin's body, and its inputs; of all environments or of one.

    Attributes:
        pose: position and quaternion, [..., 7].
        velocity: linear and angular, [..., 6].
        force: applied force and torque, [..., 6].
        is_tied: whether the lead pulls it, [..., 1].
        lead_turn: quaternion of the lead, [..., 4].
        controls: of the robot, [..., 2].
        places: positions of all mocap bodies, metres, [..., 3 * mocap bodies].
    """

    pose: Any
    velocity: Any
    force: Any
    is_tied: Any
    lead_turn: Any
    controls: Any
    places: Any


@compiled
def body_of(bodies: Any, index: int) -> Any:
    """Return the body of one environment."""
    return Body(
        bodies.pose[index],
        bodies.velocity[index],
        bodies.force[index],
        bodies.is_tied[index],
        bodies.lead_turn[index],
        bodies.controls[index],
        bodies.places[index],
    )


@compiled
def course_step(environment: Any, course: Any) -> int:
    """Return the index into f(t); a caller may go on after the end of an episode."""
    at: int = min(environment.steps, len(course.positions) - 1)
    return at


@compiled
def place_gremlins(task: Any, environment: Any, qpos: Any, course: Any) -> None:
    """Place the gremlins at f(t) from the centre of their circles; the simulated one is where its body is."""
    at = course_step(environment, course)
    for gremlin in range(task.stop[GREMLINS] - task.start[GREMLINS]):
        point = environment.points[task.start[GREMLINS] + gremlin]
        if gremlin == environment.embodied:
            point[0], point[1] = qpos[task.gremlin_qpos], qpos[task.gremlin_qpos + 1]
        else:
            point[0] = environment.circles[gremlin, 0] + course.positions[at, 0]
            point[1] = environment.circles[gremlin, 1] + course.positions[at, 1]


@compiled
def nearest_gremlin(task: Any, environment: Any, robot: Any) -> int:
    """Return the gremlin that the robot may meet next, or NO_GREMLIN."""
    nearest, least = NO_GREMLIN, math.inf
    for gremlin in range(task.stop[GREMLINS] - task.start[GREMLINS]):
        place = environment.points[task.start[GREMLINS] + gremlin]
        apart = math.hypot(place[0] - robot[0], place[1] - robot[1])
        if apart < least:
            nearest, least = gremlin, apart
    return nearest if least <= task.gremlin_alert else NO_GREMLIN


@compiled
def replaceable(task: Any, environment: Any, body: Any, course: Any) -> bool:
    """Whether the simulated gremlin, if any, may be released: it is untouched and on its course."""
    if environment.embodied < 0:
        return True
    if environment.touching[task.first_body[GREMLINS]]:
        return False
    undisturbed, place = course.positions[course_step(environment, course)], body.pose
    circle = environment.circles[environment.embodied]
    x, y = place[0] - undisturbed[0] - circle[0], place[1] - undisturbed[1] - circle[1]
    z = place[2] - undisturbed[2]
    near: bool = x * x + y * y + z * z < task.gremlin_on_course * task.gremlin_on_course
    return near


@compiled
def make_body(task: Any, environment: Any, body: Any, gremlin: int, course: Any) -> None:
    """Make this gremlin the body. With NO_GREMLIN the body hovers untied at a place without objects."""
    environment.embodied = gremlin
    body.is_tied[0] = 1.0 if gremlin >= 0 else 0.0
    if gremlin < 0:
        for axis in range(3):
            body.pose[axis] = task.gremlin_idle_place[axis]
        for axis in range(6):
            body.velocity[axis] = 0.0
        body.force[2] = task.gremlin_weight
        return
    body.force[2] = 0.0
    at = course_step(environment, course)
    for axis in range(3):
        body.pose[axis] = course.positions[at, axis]
    for axis in range(6):
        body.velocity[axis] = course.velocities[at, axis]
    body.pose[0] += environment.circles[gremlin, 0]
    body.pose[1] += environment.circles[gremlin, 1]
    half = environment.gremlin_yaws[gremlin] / 2.0
    for quaternion in (body.pose[3:], body.lead_turn[:]):
        quaternion[0], quaternion[3] = math.cos(half), math.sin(half)
        quaternion[1] = quaternion[2] = 0.0


@compiled_for_arrays
def choose_bodies(task: Any, world: Any, bodies: Any) -> None:
    """Make the gremlins that the robots may meet next the bodies, where the present ones may be released.

    Args:
        task: the record ``TASK``.
        world: of all environments.
        bodies: ``Body`` of all environments.
    """
    for index in range(len(world.environments)):
        environment = world.environments[index]
        wanted = nearest_gremlin(task, environment, world.physics.place[index])
        if wanted != environment.embodied:
            body = body_of(bodies, index)
            if replaceable(task, environment, body, world.course):
                make_body(task, environment, body, wanted, world.course)


@compiled_for_arrays
def lead_gremlins(task: Any, world: Any, bodies: Any, chosen: Any, inputs: Any) -> None:
    """Write the inputs of each physics step of environments in which a gremlin is the body.

    The mocap body that leads it moves: 0.35 (sin t, cos t) from the centre of its circle.

    Args:
        task: the record ``TASK``.
        world: of all environments.
        bodies: ``Body`` of all environments.
        chosen: indices of these environments, [n].
        inputs: controls and places in each physics step, [n, substeps, numbers].
    """
    first = bodies.controls.shape[1]
    lead = first + 3 * task.gremlin_lead
    for row, index in enumerate(chosen):
        environment = world.environments[index]
        circle = environment.circles[environment.embodied]
        for substep in range(task.substeps):
            given = inputs[row, substep]
            given[:first] = bodies.controls[index]
            given[first:] = bodies.places[index]
            time = task.timestep * (environment.steps * task.substeps + substep)
            given[lead] = circle[0] + task.gremlin_travel * math.sin(time)
            given[lead + 1] = circle[1] + task.gremlin_travel * math.cos(time)
