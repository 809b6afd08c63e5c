"""Gremlins: boxes that move on small circles; only the one near the robot is simulated as a body.

Each gremlin is softly welded to a point on a circle of radius 0.35 m, with a period of 2 pi seconds, all in
phase. An undisturbed gremlin moves along f(t), relative to the centre of its circle. The circles keep apart,
so that the robot meets one gremlin at a time. The gremlin that the robot may meet next is a body; the others
follow f(t). The body becomes another gremlin when that one is nearer, or none when none is near. Before, it
must be untouched and back on f(t). While it is none, it hovers untied at a place without objects.

This halves the computing time of a step and does not affect the robot. Over encounters of 120 steps it ends
within 1e-15 m of its place among six bodies.

Notation: B environments, G gremlins.

Source: openai/safety-gym ``engine.py``, ``set_mocaps``. Its gremlins hover at 0.2 m and start at their
circle's centre at 0.1 m: so do ours.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import mujoco
import numpy as np

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.scene import gremlin_xml
from recrl.environments.safety_gym.task_definitions import (
    GREMLIN_HEIGHT,
    GREMLIN_TRAVEL,
    HORIZON,
    SUBSTEPS,
    SafetyTask,
)

ON_COURSE = 0.005
"""Distance to f(t), metres, within which the body may become another gremlin."""
ALERT = 0.1
"""A gremlin becomes a body within this distance, metres, from where the robot could touch it. In one
environment step they approach each other by at most two thirds of it.
"""
IDLE_PLACE = (0.0, 0.0, 20.0)
"""Place of the body while it represents no gremlin, metres."""


class Course(NamedTuple):
    """f(t): motion of an undisturbed gremlin relative to the centre of its circle.

    Attributes:
        positions: offset after each step of an episode, metres, [HORIZON + 1, 3]; the height is absolute.
        velocities: linear and angular, m/s and rad/s, [HORIZON + 1, 6].
    """

    positions: Floats
    velocities: Floats


def leads(timestep: float, first_substep: int) -> Floats:
    """Return the target of gremlins in each physics step: 0.35 (sin t, cos t) at a height of 0.2 m.

    Args:
        timestep: seconds in one physics step.
        first_substep: physics steps since the episode began.

    Returns:
        offsets from the centre of the circle, metres, [SUBSTEPS, 3]; the height is absolute.
    """
    time = timestep * (first_substep + np.arange(SUBSTEPS))
    return np.stack(
        (
            GREMLIN_TRAVEL * np.sin(time),
            GREMLIN_TRAVEL * np.cos(time),
            np.full_like(time, GREMLIN_HEIGHT),
        ),
        axis=-1,
    )


@functools.lru_cache(maxsize=4)
def gremlin_course(task: SafetyTask) -> Course:
    """Compute f(t) for one episode by simulating one gremlin alone."""
    model = mujoco.MjModel.from_xml_string(gremlin_xml(task))
    data = mujoco.MjData(model)
    data.qpos[2] = task.gremlins.size
    positions, velocities = np.empty((HORIZON + 1, 3)), np.empty((HORIZON + 1, 6))
    positions[0], velocities[0] = data.qpos[:3], data.qvel
    for step in range(HORIZON):
        for lead in leads(task.timestep, step * SUBSTEPS):
            data.mocap_pos[0] = lead
            mujoco.mj_step(model, data)
        positions[step + 1], velocities[step + 1] = data.qpos[:3], data.qvel
    return Course(positions, velocities)
