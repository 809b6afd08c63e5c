"""Records that the compiled step reads and writes, and access to the fields of ``mjData`` and of the robot.

A record ``ENVIRONMENT`` holds the state of one environment. The record ``TASK`` holds what all environments
of a task share. Their sizes fit every task.

Notation: P objects that the lidar sees; R the rotation from the robot's frame to the world frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from recrl.environments.simulation.machine_code import array_at, compiled

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

tasks_at = array_at(TASK)
environments_at = array_at(ENVIRONMENT)
outcomes_at = array_at(OUTCOME)
doubles_at = array_at(np.float64)
integers_at = array_at(np.int32)
floats_at = array_at(np.float32)
bytes_at = array_at(np.uint8)
addresses_at = array_at(np.int64)


@compiled
def field(data: int, offset: int, size: int) -> Any:
    """An array of ``mjData``, [size]."""
    return doubles_at(addresses_at(data + offset, 1)[0], size)


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
