"""Records that compiled functions read and write, and MuJoCo's results that they read.

A record ``ENVIRONMENT`` holds the state of one environment. The record ``TASK`` holds what all environments
of a task share. Their sizes fit every task. ``Physics`` has what MuJoCo computed.

Notation: P objects that the lidar sees; R the rotation from the robot's frame to the world frame.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from recrl.environments.safety_gym.gremlins import Course
from recrl.environments.simulation.machine_code import compiled

KINDS = ("goal", "box", "buttons", "hazards", "vases", "pillars", "gremlins")
"""Kinds of objects, in the order of ``TASK``'s fields of seven."""
GOAL, BOX, BUTTONS, HAZARDS, VASES, PILLARS, GREMLINS = range(7)
TERMS = ("hazards", "vases_contact", "vases_velocity", "pillars", "buttons", "gremlins")
"""All cost terms, in the order in which they are computed."""
SENSORS = ("accelerometer", "velocimeter", "gyro", "magnetometer", "ballquat_rear", "ballangvel_rear")
"""Sensors of a robot, in the order of the field ``TASK["sensors"]``."""
ACCELEROMETER, VELOCIMETER, GYRO, MAGNETOMETER, BALL, SPIN = range(6)
FLAGS = ("goal_met", "truncated")
"""Results of a step besides rewards, costs and the indicators of the cost terms."""
MAX_POINTS, MAX_BODIES, MAX_GREMLINS, MAX_TERMS = 24, 24, 6, 3
"""Maximum sizes: P objects, bodies of a model, and so on."""
NO_GREMLIN = -1
"""No gremlin is a body: it hovers untied at a place without objects."""
NOT_YET = -2
"""A new episode: no gremlin was made a body yet, and the body has its initial pose."""

TASK = np.dtype(
    [
        # The model.
        ("timestep", np.float64),  # seconds
        ("substeps", np.int64),
        ("is_car", np.bool_),
        ("touchable", np.int64, (MAX_BODIES,)),  # the body whose contacts with the robot each sensor counts
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
        ("gremlin_lead", np.int64),  # the mocap body that the gremlin is tied to
        ("gremlin_weight", np.float64),  # newtons
        ("gremlin_travel", np.float64),
        ("gremlin_alert", np.float64),  # metres
        ("gremlin_on_course", np.float64),
        ("gremlin_idle_place", np.float64, (3,)),
    ],
    align=True,
)

ENVIRONMENT = np.dtype(
    [
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


class Physics(NamedTuple):
    """What MuJoCo has of all environments, [B, ...] each, or of one of them, [...] each.

    Attributes:
        qpos, qvel, qacc: coordinates, velocities and accelerations.
        place: the robot's position, metres, [..., 3].
        rotation: R by rows, [..., 9].
        contacts: readings of the model's sensors: contacts between the robot and each touchable body.
    """

    qpos: Any
    qvel: Any
    qacc: Any
    place: Any
    rotation: Any
    contacts: Any


class World(NamedTuple):
    """All that compiled functions read and write of all environments.

    Attributes:
        environments: records ``ENVIRONMENT``, [B].
        physics: what MuJoCo computed.
        course: f(t), see ``recrl.environments.safety_gym.gremlins``; empty without gremlins.
        outcomes: records ``OUTCOME`` of the last step, [B].
        observations: [B, size].
    """

    environments: Any
    physics: Physics
    course: Course
    outcomes: Any
    observations: Any


@compiled
def physics_of(physics: Any, index: int) -> Any:
    """Return the physics of one environment."""
    return Physics(
        physics.qpos[index],
        physics.qvel[index],
        physics.qacc[index],
        physics.place[index],
        physics.rotation[index],
        physics.contacts[index],
    )


@compiled
def turned(rotation: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """R^T (x, y, z): a vector of the world frame in the robot's frame; R is given by rows, [9]."""
    return (
        rotation[0] * x + rotation[3] * y + rotation[6] * z,
        rotation[1] * x + rotation[4] * y + rotation[7] * z,
        rotation[2] * x + rotation[5] * y + rotation[8] * z,
    )
