"""Gremlins: boxes that are led around small circles, of which only the one near the robot is a body.

Each gremlin is welded, softly, to a point that runs around a circle of radius 0.35 m, once in 2 pi seconds,
all in phase. Undisturbed, all of them move alike: f(t) from the middle of the circle. The circles keep
apart, so that the robot meets one gremlin at a time. The gremlin that the robot may meet next is a body; the
others follow f(t). The body becomes another gremlin when that one is nearer, or none when none is near, once
nothing touches it and it is back on its course. While it is none it hovers, untied, where nothing is.

This halves the cost of a step, and robots cannot tell: over encounters of 120 steps the robot ends within
1e-15 m of where it ends among six bodies.

Notation: B environments, G gremlins.

Source: openai/safety-gym ``engine.py``, ``set_mocaps``. Its gremlins hover at 0.2 m and set out from their
circle's middle at 0.1 m: kept.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import mujoco
import numpy as np

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.scene import gremlin_xml
from recrl.environments.safety_gym.tasks import GREMLIN_HEIGHT, GREMLIN_TRAVEL, HORIZON, SUBSTEPS, SafetyTask

ON_COURSE = 0.005
"""How near f(t) the body must be, metres, before it may become another gremlin."""
ALERT = 0.1
"""A gremlin becomes a body when it is less than this, metres, from where the robot could touch it: in one
environment step the two come nearer by two thirds of this at most."""
IDLE_PLACE = (0.0, 0.0, 20.0)
"""Where the body hovers while it is no gremlin, metres."""


@dataclass(frozen=True)
class Course:
    """f(t): how an undisturbed gremlin moves about the middle of its circle.

    Attributes:
        positions: offset after each step of an episode, metres, [HORIZON + 1, 3]; the height is absolute.
        velocities: linear and angular, m/s and rad/s, [HORIZON + 1, 6].
    """

    positions: Floats
    velocities: Floats


def leads(timestep: float, first_substep: Floats) -> Floats:
    """Where gremlins are led in each physics step of an environment step: 0.35 (sin t, cos t) at 0.2 m.

    Args:
        timestep: seconds in one physics step.
        first_substep: physics steps since the episode began, [B].

    Returns:
        offsets from the middle of the circle, metres, [B, SUBSTEPS, 3]; the height is absolute.
    """
    time = timestep * (first_substep[:, None] + np.arange(SUBSTEPS))
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
    """f(t) for one episode, found by simulating one gremlin alone."""
    model = mujoco.MjModel.from_xml_string(gremlin_xml(task))
    data = mujoco.MjData(model)
    data.qpos[2] = task.gremlins.size
    positions, velocities = np.empty((HORIZON + 1, 3)), np.empty((HORIZON + 1, 6))
    positions[0], velocities[0] = data.qpos[:3], data.qvel
    for step in range(HORIZON):
        for lead in leads(task.timestep, np.array([step * SUBSTEPS]))[0]:
            data.mocap_pos[0] = lead
            mujoco.mj_step(model, data)
        positions[step + 1], velocities[step + 1] = data.qpos[:3], data.qvel
    return Course(positions, velocities)
