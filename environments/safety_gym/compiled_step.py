"""One step of one environment of a Safety Gym task, compiled to machine code.

``step`` is called for each environment, on any of MuJoCo's threads: it sets the action, takes ten physics
steps and computes observation, reward and cost. It reads no other environment, so results depend neither on
their number nor on the threads. Resets and new goals are sampled elsewhere
(``recrl.environments.safety_gym.safety_gym_batch``).

A record ``ENVIRONMENT`` holds the state of one environment. The record ``TASK`` holds what all environments
of a task share. Their sizes fit every task.

Notation: P objects that the lidar sees; R the rotation from the robot's frame to the world frame.

Source: openai/safety-gym ``engine.py``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from recrl.environments.simulation.machine_code import (
    array_at,
    compiled,
    compiled_for_batch,
    compiled_for_python,
    mj_forward,
    mj_getState,
    mj_step,
    mj_step2,
)

KINDS = ("goal", "box", "buttons", "hazards", "vases", "pillars", "gremlins")
"""Kinds of objects, in the order of ``TASK``'s fields of seven."""
GOAL, BOX, BUTTONS, HAZARDS, VASES, PILLARS, GREMLINS = range(7)
TERMS = ("hazards", "vases_contact", "vases_velocity", "pillars", "buttons", "gremlins")
"""All cost terms, in the order in which they are computed."""
SENSORS = ("accelerometer", "velocimeter", "gyro", "magnetometer", "ballquat_rear", "ballangvel_rear")
"""Sensors of a robot, in the order of the field ``TASK["sensor"]``."""
ACCELEROMETER, VELOCIMETER, GYRO, MAGNETOMETER, BALL, SPIN = range(6)
FLAGS = ("goal_met", "broken", "terminated", "truncated")
"""Results of a step besides rewards, costs and the indicators of the cost terms."""
MAX_POINTS, MAX_BODIES, MAX_GEOMS, MAX_GREMLINS, MAX_TERMS = 24, 24, 64, 6, 3
"""Maximum sizes: P objects, bodies and shapes of a model, and so on."""
NO_GREMLIN = -1
"""No gremlin is a body: it hovers untied at a place without objects."""
NOT_YET = -2
"""A new episode: no gremlin was made a body yet, and the body has its initial pose."""

TASK = np.dtype(
    [
        ("environments", np.int64),  # address of the records of the environments
        ("number", np.int64),
        ("outcomes", np.int64),  # address of the results of the last step, [B] OUTCOMEs
        ("observations", np.int64),  # address of [B, observed]
        ("rows", np.int64),  # address of [B, 2, row]: the state after the last step, and room for another
        ("row", np.int64),  # numbers in a state
        ("row_fields", np.int32),  # mjtState
        # Offsets of fields in mjData and mjContact.
        ("qpos", np.int64),
        ("qvel", np.int64),
        ("qacc", np.int64),
        ("ctrl", np.int64),
        ("qfrc_applied", np.int64),
        ("eq_active", np.int64),
        ("mocap_pos", np.int64),
        ("mocap_quat", np.int64),
        ("xpos", np.int64),
        ("xmat", np.int64),
        ("ncon", np.int64),
        ("contact", np.int64),
        ("contact_size", np.int64),
        ("contact_geom", np.int64),
        ("warnings", np.int64, (3,)),  # counts of bad positions, velocities, accelerations
        # The model.
        ("nq", np.int64),
        ("nv", np.int64),
        ("nbody", np.int64),
        ("nmocap", np.int64),
        ("timestep", np.float64),  # seconds
        ("substeps", np.int64),
        ("robot", np.int64),  # its body
        ("is_car", np.bool_),
        ("root", np.int64, (MAX_GEOMS,)),  # the outermost body that each shape is part of
        ("vase_qpos", np.int64),  # the vases' coordinates and velocities are contiguous
        ("vase_qvel", np.int64),
        ("box_qpos", np.int64),
        # The task.
        ("start", np.int64, (len(KINDS),)),  # each kind's range among P
        ("stop", np.int64, (len(KINDS),)),
        ("first_body", np.int64, (len(KINDS),)),  # bodies of each kind, if contacts with them matter
        ("last_body", np.int64, (len(KINDS),)),
        ("lidar", np.int64, (len(KINDS),)),  # offset of each kind in an observation, -1 for none
        ("sensors", np.int64, (len(SENSORS),)),  # their offsets in an observation, -1 for none
        ("observed", np.int64),  # size of an observation
        ("terms", np.int64, (MAX_TERMS,)),  # cost terms: indices of TERMS
        ("num_terms", np.int64),
        ("horizon", np.int64),
        ("is_push", np.bool_),
        ("is_button", np.bool_),
        ("goal_size", np.float64),  # metres
        ("goal_height", np.float64),
        ("hazard_size", np.float64),
        ("vase_speed", np.float64),  # m/s
        ("reward_bound", np.float64),
        ("lidar_bins", np.int64),
        ("lidar_range", np.float64),
        ("gravity", np.float64),
        ("magnetic_field", np.float64),
        # Gremlins: see recrl.environments.safety_gym.gremlins.
        ("gremlin_qpos", np.int64),
        ("gremlin_qvel", np.int64),
        ("gremlin_lead", np.int64),  # the mocap body that the gremlin is tied to
        ("gremlin_weight", np.float64),  # newtons
        ("gremlin_travel", np.float64),
        ("gremlin_alert", np.float64),  # metres
        ("gremlin_on_course", np.float64),
        ("gremlin_idle_place", np.float64, (3,)),
        ("course_steps", np.int64),
        ("course_positions", np.int64),  # addresses of f(t), [course_steps, 3] and [course_steps, 6]
        ("course_velocities", np.int64),
    ],
    align=True,
)

ENVIRONMENT = np.dtype(
    [
        ("action", np.float64, (2,)),
        ("steps", np.int64),
        ("points", np.float64, (MAX_POINTS, 2)),  # (x, y) of what the lidar sees, metres
        ("distances", np.float64, (2,)),  # distances before the step, for the reward, metres
        ("goal_button", np.int64),
        ("button_timer", np.int64),
        ("circles", np.float64, (MAX_GREMLINS, 2)),
        ("gremlin_yaws", np.float64, (MAX_GREMLINS,)),
        ("embodied", np.int64),
        ("acceleration", np.float64, (3,)),  # of the robot, in the world frame, m/s^2
        ("touching", np.uint8, (MAX_BODIES,)),  # 0 or 1; Numba has no boolean arrays in records
        ("measured", np.float64, (2,)),  # as distances, after the step
        ("terms", np.float64, (MAX_TERMS,)),
        ("goal_met", np.bool_),
        ("broken", np.bool_),
    ],
    align=True,
)

OUTCOME = np.dtype(
    [
        ("numbers", np.float64, (2 + MAX_TERMS,)),  # reward, cost, the indicator of each cost term
        ("flags", np.uint8, (len(FLAGS),)),  # 0 or 1
    ],
    align=True,
)

_tasks = array_at(TASK)
_environments = array_at(ENVIRONMENT)
_outcomes = array_at(OUTCOME)
_doubles = array_at(np.float64)
_integers = array_at(np.int32)
_floats = array_at(np.float32)
_bytes = array_at(np.uint8)
_addresses = array_at(np.int64)


@compiled
def field(data: int, offset: int, size: int) -> Any:
    """An array of ``mjData``, [size]."""
    return _doubles(_addresses(data + offset, 1)[0], size)


@compiled
def robot_place(task: Any, data: int) -> Any:
    """The robot's position, metres, [3]."""
    return field(data, task.xpos, 3 * task.nbody)[3 * task.robot : 3 * task.robot + 3]


@compiled
def robot_rotation(task: Any, data: int) -> Any:
    """R by rows, [9]."""
    return field(data, task.xmat, 9 * task.nbody)[9 * task.robot : 9 * task.robot + 9]


@compiled
def turned(rotation: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """R^T (x, y, z): a vector of the world frame in the robot's frame; R is given by rows, [9]."""
    return (
        rotation[0] * x + rotation[3] * y + rotation[6] * z,
        rotation[1] * x + rotation[4] * y + rotation[7] * z,
        rotation[2] * x + rotation[5] * y + rotation[8] * z,
    )


@compiled
def write_rotation(quaternion: Any, out: Any) -> None:
    """Write the rotation matrix, by rows [9], of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    out[0], out[1], out[2] = w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    out[3], out[4], out[5] = 2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)
    out[6], out[7], out[8] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z


@compiled
def add_to_lidar(x: float, y: float, lidar_range: float, bins: Any) -> None:
    """Add one object to the pseudo-lidar: each bin holds the maximum over objects.

    The circle around the robot is divided into sectors. An object at distance d reads r = max(0, 1 - d /
    range) in its own sector. With u in [0, 1) its relative angle there, it reads u r in the next
    sector and (1 - u) r in the one before ("aliasing").

    Args:
        x: the object's place in the robot's frame, metres.
        y: likewise.
        lidar_range: metres.
        bins: readings so far, [sectors].
    """
    reading = 1.0 - math.hypot(x, y) / lidar_range
    if not reading > 0.0:
        return
    sectors = len(bins)
    sector = math.atan2(y, x) * (sectors / (2.0 * math.pi))
    if sector < 0.0:
        sector += sectors
    own = int(sector)
    through = sector - own
    own %= sectors
    after, before = (own + 1) % sectors, (own - 1) % sectors
    bins[own] = max(bins[own], reading)
    bins[after] = max(bins[after], through * reading)
    bins[before] = max(bins[before], (1.0 - through) * reading)


@compiled
def look(task: Any, environment: Any, data: int) -> None:
    """Update the objects' positions and the robot's contacts; ``mj_forward`` was called before."""
    qpos = field(data, task.qpos, task.nq)
    for vase in range(task.stop[VASES] - task.start[VASES]):
        address = task.vase_qpos + 7 * vase
        environment.points[task.start[VASES] + vase, 0] = qpos[address]
        environment.points[task.start[VASES] + vase, 1] = qpos[address + 1]
    for box in range(task.start[BOX], task.stop[BOX]):
        environment.points[box, 0], environment.points[box, 1] = qpos[task.box_qpos], qpos[task.box_qpos + 1]
    if task.start[GREMLINS] < task.stop[GREMLINS]:
        place_gremlins(task, environment, qpos)
    qacc = field(data, task.qacc, task.nv)
    environment.acceleration[0], environment.acceleration[1] = qacc[0], qacc[1]
    environment.acceleration[2] = qacc[2] if task.is_car else 0.0
    for body in range(task.nbody):
        environment.touching[body] = 0
    size = task.contact_size // 4
    contacts = _integers(data + task.ncon, 1)[0]
    geoms = _integers(_addresses(data + task.contact, 1)[0], contacts * size)
    for contact in range(contacts):
        place = contact * size + task.contact_geom // 4
        one, other = task.root[geoms[place]], task.root[geoms[place + 1]]
        if one == task.robot:
            environment.touching[other] = 1
        elif other == task.robot:
            environment.touching[one] = 1
    environment.touching[0] = 0  # the floor
    environment.touching[task.robot] = 0
    environment.broken = False
    for warning in task.warnings:
        if _integers(data + warning, 1)[0] > 0:
            environment.broken = True


@compiled
def course_step(task: Any, environment: Any) -> int:
    """Return the index into f(t); a caller may go on after the end of an episode."""
    at: int = min(environment.steps, task.course_steps - 1)
    return at


@compiled
def place_gremlins(task: Any, environment: Any, qpos: Any) -> None:
    """Place the gremlins at f(t) from the centre of their circles; the simulated one is where its body is."""
    course, at = _doubles(task.course_positions, 3 * task.course_steps), 3 * course_step(task, environment)
    for gremlin in range(task.stop[GREMLINS] - task.start[GREMLINS]):
        point = environment.points[task.start[GREMLINS] + gremlin]
        if gremlin == environment.embodied:
            point[0], point[1] = qpos[task.gremlin_qpos], qpos[task.gremlin_qpos + 1]
        else:
            point[0] = environment.circles[gremlin, 0] + course[at]
            point[1] = environment.circles[gremlin, 1] + course[at + 1]


@compiled
def measure(task: Any, environment: Any, data: int) -> None:
    """Compute the distances of the reward, metres.

    Goal and Button: from the robot to the goal, horizontally. Push: from the robot to the box and from the
    box to the goal, in three dimensions.
    """
    robot = robot_place(task, data)
    goal = environment.points[task.start[GOAL]]
    if not task.is_push:
        environment.measured[0] = math.hypot(goal[0] - robot[0], goal[1] - robot[1])
        return
    box = field(data, task.qpos, task.nq)[task.box_qpos : task.box_qpos + 3]
    to_box = math.hypot(box[0] - robot[0], box[1] - robot[1])
    to_goal = math.hypot(goal[0] - box[0], goal[1] - box[1])
    environment.measured[0] = math.hypot(to_box, box[2] - robot[2])
    environment.measured[1] = math.hypot(to_goal, box[2] - task.goal_height)


@compiled
def touches(task: Any, environment: Any, kind: int) -> bool:
    """Whether the robot touches any object of a kind."""
    for body in range(task.first_body[kind], task.last_body[kind]):  # noqa: SIM110  # not for Numba
        if environment.touching[body]:
            return True
    return False


@compiled
def presses_wrongly(task: Any, environment: Any) -> bool:
    """Whether the robot touches a wrong button while buttons are active."""
    if environment.button_timer > 0:
        return False
    for button in range(task.last_body[BUTTONS] - task.first_body[BUTTONS]):
        if button != environment.goal_button and environment.touching[task.first_body[BUTTONS] + button]:
            return True
    return False


@compiled
def over_a_hazard(task: Any, environment: Any, data: int) -> bool:
    """Whether the horizontal distance between the robot and a hazard's centre is below the hazard's size."""
    robot = robot_place(task, data)
    for hazard in range(task.start[HAZARDS], task.stop[HAZARDS]):
        place = environment.points[hazard]
        if math.hypot(place[0] - robot[0], place[1] - robot[1]) < task.hazard_size:
            return True
    return False


@compiled
def moves_a_vase(task: Any, data: int) -> bool:
    """Whether any vase moves; a sleeping vase has no velocity."""
    qvel = field(data, task.qvel, task.nv)
    for vase in range(task.stop[VASES] - task.start[VASES]):
        address = task.vase_qvel + 6 * vase
        x, y, z = qvel[address], qvel[address + 1], qvel[address + 2]
        if x * x + y * y + z * z >= task.vase_speed * task.vase_speed:
            return True
    return False


@compiled
def judge(task: Any, environment: Any, data: int) -> None:
    """Compute the distances, the cost terms, and whether the goal is reached."""
    measure(task, environment, data)
    for column in range(task.num_terms):
        term = task.terms[column]  # the order is that of TERMS
        if term == 0:
            costs = over_a_hazard(task, environment, data)
        elif term == 1:
            costs = touches(task, environment, VASES)
        elif term == 2:
            costs = moves_a_vase(task, data)
        elif term == 3:
            costs = touches(task, environment, PILLARS)
        elif term == 4:
            costs = presses_wrongly(task, environment)
        else:
            costs = touches(task, environment, GREMLINS)
        environment.terms[column] = 1.0 if costs else 0.0
    if task.is_button:
        environment.goal_met = environment.touching[task.first_body[BUTTONS] + environment.goal_button]
    else:
        environment.goal_met = environment.measured[1 if task.is_push else 0] <= task.goal_size


@compiled
def observe(task: Any, environment: Any, data: int, index: int) -> None:
    """Write the whole observation: lidar and sensors."""
    seen = _floats(task.observations + 4 * task.observed * index, task.observed)
    size = task.lidar_bins
    rotation, robot = robot_rotation(task, data), robot_place(task, data)
    for kind in range(len(task.lidar)):
        if task.lidar[kind] < 0:
            continue
        bins = seen[task.lidar[kind] : task.lidar[kind] + size]
        for sector in range(size):
            bins[sector] = 0.0
        if kind == BUTTONS and environment.button_timer > 0:
            continue
        for place in range(task.start[kind], task.stop[kind]):
            point = environment.points[place]
            x, y, _ = turned(rotation, point[0] - robot[0], point[1] - robot[1], -robot[2])
            add_to_lidar(x, y, task.lidar_range, bins)
    feel(task, environment, data, seen)


@compiled
def feel(task: Any, environment: Any, data: int, seen: Any) -> None:
    """Write the sensors' readings into an observation.

    Accelerometer R^T (a + (0, 0, g)), velocimeter R^T v, magnetometer R^T m; gyro and the rear ball's spin
    are angular velocities in the robot's frame, as MuJoCo has them; the ball's rotation is a matrix.
    """
    rotation, qvel, acceleration = (
        robot_rotation(task, data),
        field(data, task.qvel, task.nv),
        environment.acceleration,
    )
    upwards = acceleration[2] + task.gravity
    _write(seen, task.sensors[ACCELEROMETER], turned(rotation, acceleration[0], acceleration[1], upwards))
    rising = qvel[2] if task.is_car else 0.0
    _write(seen, task.sensors[VELOCIMETER], turned(rotation, qvel[0], qvel[1], rising))
    _write(seen, task.sensors[MAGNETOMETER], turned(rotation, 0.0, task.magnetic_field, 0.0))
    if not task.is_car:
        _write(seen, task.sensors[GYRO], (0.0, 0.0, qvel[2]))
        return
    _write(seen, task.sensors[GYRO], (qvel[3], qvel[4], qvel[5]))
    _write(seen, task.sensors[SPIN], (qvel[8], qvel[9], qvel[10]))
    ball = task.sensors[BALL]
    write_rotation(field(data, task.qpos, task.nq)[9:13], seen[ball : ball + 9])


@compiled
def _write(seen: Any, place: int, numbers: tuple[float, float, float]) -> None:
    for axis in range(3):
        seen[place + axis] = numbers[axis]


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
    course = _doubles(task.course_positions, 3 * task.course_steps)[3 * course_step(task, environment) :]
    circle = environment.circles[environment.embodied]
    place = field(data, task.qpos, task.nq)[task.gremlin_qpos :]
    x, y = place[0] - course[0] - circle[0], place[1] - course[1] - circle[1]
    z = place[2] - course[2]
    near: bool = x * x + y * y + z * z < task.gremlin_on_course * task.gremlin_on_course
    return near


@compiled
def embody(task: Any, environment: Any, data: int, gremlin: int) -> None:
    """Make this gremlin the body. With NO_GREMLIN the body hovers untied at a place without objects."""
    environment.embodied = gremlin
    place = field(data, task.qpos, task.nq)[task.gremlin_qpos :]
    velocity = field(data, task.qvel, task.nv)[task.gremlin_qvel :]
    lift = field(data, task.qfrc_applied, task.nv)[task.gremlin_qvel :]
    _bytes(_addresses(data + task.eq_active, 1)[0], 1)[0] = gremlin >= 0
    if gremlin < 0:
        for axis in range(3):
            place[axis] = task.gremlin_idle_place[axis]
        for axis in range(6):
            velocity[axis] = 0.0
        lift[2] = task.gremlin_weight
        return
    lift[2] = 0.0
    positions = _doubles(task.course_positions, 3 * task.course_steps)
    velocities = _doubles(task.course_velocities, 6 * task.course_steps)
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


@compiled
def act(task: Any, environment: Any, data: int) -> bool:
    """Set the controls; return False if anything else was changed, too."""
    control = field(data, task.ctrl, 2)
    control[0], control[1] = environment.action[0], environment.action[1]
    if task.start[GREMLINS] < task.stop[GREMLINS]:
        wanted = nearest_gremlin(task, environment, data)
        if wanted != environment.embodied and replaceable(task, environment, data):
            embody(task, environment, data, wanted)
            return False
    return True


@compiled
def same(one: Any, other: Any) -> bool:
    """Whether two states are equal."""
    for place in range(len(one)):  # noqa: SIM110  # not for Numba
        if one[place] != other[place]:
            return False
    return True


@compiled
def report(task: Any, environment: Any, index: int) -> None:
    """Write the results of this step; the reward is the progress in metres, within bounds."""
    outcome = _outcomes(task.outcomes, task.number)[index]
    progress = environment.distances[0] - environment.measured[0]
    if task.is_push:
        progress += environment.distances[1] - environment.measured[1]
    cost = 0.0
    for column in range(task.num_terms):
        outcome.numbers[2 + column] = environment.terms[column]
        cost = max(cost, environment.terms[column])
    outcome.numbers[0] = min(max(progress, -task.reward_bound), task.reward_bound)
    outcome.numbers[1] = cost
    outcome.flags[0] = environment.goal_met
    outcome.flags[1] = environment.broken
    outcome.flags[2] = environment.broken  # other reasons to terminate are not known here
    outcome.flags[3] = environment.steps >= task.horizon


@compiled
def begin(task: Any, environment: Any, model: int, data: int, index: int) -> bool:
    """Set the action; return whether everything else is as the last step left it."""
    left = task.rows + 8 * task.row * 2 * index
    found = left + 8 * task.row
    mj_getState(model, data, found, task.row_fields)
    untouched = same(_doubles(left, task.row), _doubles(found, task.row))
    return act(task, environment, data) and untouched


@compiled
def simulate(task: Any, environment: Any, model: int, data: int, index: int) -> None:
    """Take the physics steps of one environment step.

    After the last step MuJoCo has already computed what follows from coordinates and velocities. If nothing
    changed since, the first physics step does not compute it again; the result is the same.
    """
    untouched = begin(task, environment, model, data, index)
    leads = environment.embodied >= 0
    for substep in range(task.substeps):
        if leads:
            lead_gremlin(task, environment, data, substep)
        if substep == 0 and untouched and not leads:
            mj_step2(model, data)
        else:
            mj_step(model, data)


@compiled
def end(task: Any, environment: Any, model: int, data: int, index: int) -> None:
    """Compute everything that follows from the new state, and the results of the step."""
    mj_forward(model, data)
    mj_getState(model, data, task.rows + 8 * task.row * 2 * index, task.row_fields)
    environment.steps += 1
    look(task, environment, data)
    judge(task, environment, data)
    report(task, environment, index)
    for part in range(2):
        environment.distances[part] = environment.measured[part]
    environment.button_timer = max(environment.button_timer - 1, 0)
    observe(task, environment, data, index)


@compiled_for_batch
def step(model: int, data: int, index: int, argument: int) -> None:
    """Take one step of one environment; the action is in its record."""
    task = _tasks(argument, 1)[0]
    environment = _environments(task.environments, task.number)[index]
    simulate(task, environment, model, data, index)
    end(task, environment, model, data, index)


@compiled_for_batch
def review(_: int, data: int, index: int, argument: int) -> None:
    """Compute observation, distances and costs of one environment, after a reset or with a new goal."""
    task = _tasks(argument, 1)[0]
    environment = _environments(task.environments, task.number)[index]
    look(task, environment, data)
    judge(task, environment, data)
    observe(task, environment, data, index)


@compiled_for_batch
def perceive(_: int, data: int, index: int, argument: int) -> None:
    """Compute the observation of one environment; objects and accelerations stay as recorded."""
    task = _tasks(argument, 1)[0]
    observe(task, _environments(task.environments, task.number)[index], data, index)


@compiled_for_python
def acceptable(argument: int) -> bool:
    """Whether every action is a number within [-1, 1]."""
    task = _tasks(argument, 1)[0]
    for environment in _environments(task.environments, task.number):
        for action in environment.action:
            if not -1.0 <= action <= 1.0:
                return False
    return True
