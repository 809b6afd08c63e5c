"""Results of steps of a Safety Gym task, compiled to machine code.

MuJoCo takes the physics steps before. Then ``finish`` computes observation, reward and cost of each
environment. It reads no other environment, so results do not depend on their number. Resets and new goals are
sampled elsewhere (``recrl.environments.safety_gym.safety_gym_batch``).

Records: ``step_records``; observations: ``lidar`` and ``write_sensors``; rewards and costs:
``rewards_and_costs``; gremlins: ``gremlin_body``.

Notation: B environments; R the rotation from the robot's frame to the world frame.

Source: openai/safety-gym ``engine.py``.
"""

from __future__ import annotations

from typing import Any

from recrl.environments.safety_gym.gremlin_body import place_gremlins
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
    physics_of,
    turned,
)
from recrl.environments.simulation.machine_code import compiled, compiled_for_arrays


@compiled
def write_rotation(quaternion: Any, out: Any) -> None:
    """Write the rotation matrix, by rows [9], of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    out[0], out[1], out[2] = w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    out[3], out[4], out[5] = 2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)
    out[6], out[7], out[8] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z


@compiled
def update_from_physics(task: Any, environment: Any, data: Any, course: Any) -> None:
    """Update the objects' positions and the robot's contacts."""
    qpos, qacc = data.qpos, data.qacc
    for vase in range(task.stop[VASES] - task.start[VASES]):
        address = task.vase_qpos + 7 * vase
        environment.points[task.start[VASES] + vase, 0] = qpos[address]
        environment.points[task.start[VASES] + vase, 1] = qpos[address + 1]
    for box in range(task.start[BOX], task.stop[BOX]):
        environment.points[box, 0], environment.points[box, 1] = qpos[task.box_qpos], qpos[task.box_qpos + 1]
    if task.start[GREMLINS] < task.stop[GREMLINS]:
        place_gremlins(task, environment, qpos, course)
    environment.acceleration[0], environment.acceleration[1] = qacc[0], qacc[1]
    environment.acceleration[2] = qacc[2] if task.is_car else 0.0
    for sensor in range(len(data.contacts)):
        environment.touching[task.touchable[sensor]] = data.contacts[sensor] > 0.0


@compiled
def observe(task: Any, environment: Any, data: Any, seen: Any) -> None:
    """Write the whole observation: lidar and sensors."""
    write_lidar(task, environment, data, seen)
    write_sensors(task, environment, data, seen)


@compiled
def write_sensors(task: Any, environment: Any, data: Any, seen: Any) -> None:
    """Write the sensors' readings into an observation.

    Accelerometer R^T (a + (0, 0, g)), velocimeter R^T v, magnetometer R^T m; gyro and the rear ball's spin
    are angular velocities in the robot's frame, as MuJoCo has them; the ball's rotation is a matrix.
    """
    rotation, qvel, acceleration = data.rotation, data.qvel, environment.acceleration
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
    write_rotation(data.qpos[9:13], seen[ball : ball + 9])


@compiled
def _write(seen: Any, place: int, numbers: tuple[float, float, float]) -> None:
    for axis in range(3):
        seen[place + axis] = numbers[axis]


@compiled_for_arrays
def finish(task: Any, world: Any) -> None:
    """Compute the results of one step of all environments, after MuJoCo took the physics steps.

    Args:
        task: the record ``TASK``.
        world: of all environments.
    """
    for index in range(len(world.environments)):
        environment, data = world.environments[index], physics_of(world.physics, index)
        environment.steps += 1
        update_from_physics(task, environment, data, world.course)
        compute_costs(task, environment, data)
        write_outcome(task, environment, world.outcomes[index])
        for part in range(2):
            environment.distances[part] = environment.measured[part]
        environment.button_timer = max(environment.button_timer - 1, 0)
        observe(task, environment, data, world.observations[index])


@compiled_for_arrays
def review(task: Any, world: Any, chosen: Any) -> None:
    """Compute observation, distances and costs of some environments, after a reset or with a new goal.

    Args:
        task: the record ``TASK``.
        world: of all environments.
        chosen: indices of the environments, [n].
    """
    for index in chosen:
        environment, data = world.environments[index], physics_of(world.physics, index)
        update_from_physics(task, environment, data, world.course)
        compute_costs(task, environment, data)
        observe(task, environment, data, world.observations[index])


@compiled_for_arrays
def perceive(task: Any, world: Any) -> None:
    """Compute the observations of all environments; objects and accelerations stay as they are."""
    for index in range(len(world.environments)):
        observe(task, world.environments[index], physics_of(world.physics, index), world.observations[index])
