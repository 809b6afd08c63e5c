"""One step of one environment of a Safety Gym task, compiled to machine code.

``step`` is called for each environment, on any of MuJoCo's threads: it sets the action, takes ten physics
steps and computes observation, reward and cost. It reads no other environment, so results depend neither on
their number nor on the threads. Resets and new goals are sampled elsewhere
(``recrl.environments.safety_gym.safety_gym_batch``).

Records: ``step_records``; observations: ``lidar`` and ``write_sensors``; rewards and costs:
``rewards_and_costs``; gremlins: ``gremlin_body``.

Notation: R the rotation from the robot's frame to the world frame.

Source: openai/safety-gym ``engine.py``.
"""

from __future__ import annotations

from typing import Any

from recrl.environments.safety_gym.gremlin_body import (
    lead_gremlin,
    make_body,
    nearest_gremlin,
    place_gremlins,
    replaceable,
)
from recrl.environments.safety_gym.lidar import write_lidar
from recrl.environments.safety_gym.rewards_and_costs import compute_costs, write_outcome
from recrl.environments.safety_gym.step_records import (
    ACCELEROMETER,
    BALL,
    BOX,
    GREMLINS,
    GYRO,
    MAGNETOMETER,
    SPIN,
    VASES,
    VELOCIMETER,
    addresses_at,
    doubles_at,
    environments_at,
    field,
    floats_at,
    integers_at,
    robot_rotation,
    tasks_at,
    turned,
)
from recrl.environments.simulation.machine_code import (
    compiled,
    compiled_for_batch,
    compiled_for_python,
    mj_forward,
    mj_getState,
    mj_step,
    mj_step2,
)


@compiled
def write_rotation(quaternion: Any, out: Any) -> None:
    """Write the rotation matrix, by rows [9], of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    out[0], out[1], out[2] = w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    out[3], out[4], out[5] = 2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)
    out[6], out[7], out[8] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z


@compiled
def update_from_physics(task: Any, environment: Any, data: int) -> None:
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
    contacts = integers_at(data + task.ncon, 1)[0]
    geoms = integers_at(addresses_at(data + task.contact, 1)[0], contacts * size)
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
        if integers_at(data + warning, 1)[0] > 0:
            environment.broken = True


@compiled
def observe(task: Any, environment: Any, data: int, index: int) -> None:
    """Write the whole observation: lidar and sensors."""
    seen = floats_at(task.observations + 4 * task.observed * index, task.observed)
    write_lidar(task, environment, data, seen)
    write_sensors(task, environment, data, seen)


@compiled
def write_sensors(task: Any, environment: Any, data: int, seen: Any) -> None:
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
def act(task: Any, environment: Any, data: int) -> bool:
    """Set the controls; return False if anything else was changed, too."""
    control = field(data, task.ctrl, 2)
    control[0], control[1] = environment.action[0], environment.action[1]
    if task.start[GREMLINS] < task.stop[GREMLINS]:
        wanted = nearest_gremlin(task, environment, data)
        if wanted != environment.embodied and replaceable(task, environment, data):
            make_body(task, environment, data, wanted)
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
def begin(task: Any, environment: Any, model: int, data: int, index: int) -> bool:
    """Set the action; return whether everything else is as the last step left it."""
    left = task.rows + 8 * task.row * 2 * index
    found = left + 8 * task.row
    mj_getState(model, data, found, task.row_fields)
    untouched = same(doubles_at(left, task.row), doubles_at(found, task.row))
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
    update_from_physics(task, environment, data)
    compute_costs(task, environment, data)
    write_outcome(task, environment, index)
    for part in range(2):
        environment.distances[part] = environment.measured[part]
    environment.button_timer = max(environment.button_timer - 1, 0)
    observe(task, environment, data, index)


@compiled_for_batch
def step(model: int, data: int, index: int, argument: int) -> None:
    """Take one step of one environment; the action is in its record."""
    task = tasks_at(argument, 1)[0]
    environment = environments_at(task.environments, task.number)[index]
    simulate(task, environment, model, data, index)
    end(task, environment, model, data, index)


@compiled_for_batch
def review(_: int, data: int, index: int, argument: int) -> None:
    """Compute observation, distances and costs of one environment, after a reset or with a new goal."""
    task = tasks_at(argument, 1)[0]
    environment = environments_at(task.environments, task.number)[index]
    update_from_physics(task, environment, data)
    compute_costs(task, environment, data)
    observe(task, environment, data, index)


@compiled_for_python
def acceptable(argument: int) -> bool:
    """Whether every action is a number within [-1, 1]."""
    task = tasks_at(argument, 1)[0]
    for environment in environments_at(task.environments, task.number):
        for action in environment.action:
            if not -1.0 <= action <= 1.0:
                return False
    return True
