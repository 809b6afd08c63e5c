"""Definitions of the six velocity tasks: rewards, costs, observations, and when a robot has fallen.

Rewards, healthy ranges and reset noise are those of Gymnasium's MuJoCo environments, version 4; thresholds
are those of safety-gymnasium's version 1.

Notation: B robots; nq coordinates and nv velocities of a robot.

Source: Farama-Foundation/Gymnasium ``envs/mujoco/*_v4.py``; PKU-Alignment/safety-gymnasium
``tasks/safe_velocity/*_v1.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats

Booleans = npt.NDArray[np.bool_]

HORIZON = 1000
"""Steps in an episode, at most."""


@dataclass(frozen=True)
class VelocityTask:
    """Definition of one velocity task.

    Attributes:
        name: for example ``SafetyAntVelocity``.
        model: file name of the robot's model in Gymnasium.
        frame_skip: physics steps in a step.
        threshold: the velocity above which a step costs 1, m/s.
        measured: the point whose velocity counts: the first coordinates (``root``), the torso (``torso``) or
            the centre of mass (``mass``).
        axes: 1 if only the x axis counts, 2 if the velocity that costs is sqrt(vx^2 + vy^2).
        hidden: coordinates, from the first one, that are not observed.
        forward_weight: reward of 1 m/s along x.
        control_weight: weight of the sum of squared actions, subtracted from the reward.
        healthy_reward: reward of each step for being healthy.
        position_noise: largest initial deviation of coordinates from the model's.
        velocity_noise: likewise of velocities; their standard deviation if ``normal_velocities``.
        normal_velocities: whether velocities start normally distributed, not uniformly.
        velocity_bound: observed velocities are clipped to plus or minus this.
        observes_bodies: whether inertias, velocities and forces of all bodies are observed.
        healthy: (coordinates [B, nq], velocities [B, nv]) -> whether each robot is healthy, [B]; None if it
            always is.
        camera_distance: for frames, metres.
    """

    name: str
    model: str
    frame_skip: int
    threshold: float
    measured: Literal["root", "torso", "mass"]
    axes: Literal[1, 2]
    hidden: int
    control_weight: float
    position_noise: float
    velocity_noise: float
    forward_weight: float = 1.0
    healthy_reward: float = 0.0
    normal_velocities: bool = False
    velocity_bound: float = np.inf
    observes_bodies: bool = False
    healthy: Callable[[Floats, Floats], Booleans] | None = None
    camera_distance: float = 4.0

    @property
    def robot(self) -> str:
        """For example ``Ant``."""
        return self.name.removeprefix("Safety").removesuffix("Velocity")


def ant_is_healthy(qpos: Floats, qvel: Floats) -> Booleans:
    """Torso between 0.2 m and 1 m high, everything finite; of qpos [B, nq] and qvel [B, nv], [B]."""
    height = qpos[:, 2]
    finite = np.isfinite(qpos).all(axis=1) & np.isfinite(qvel).all(axis=1)
    return np.asarray((height >= 0.2) & (height <= 1.0) & finite)


def hopper_is_healthy(qpos: Floats, qvel: Floats) -> Booleans:
    """Torso more than 0.7 m high and leaning less than 0.2 rad, all else within 100; [B]."""
    height, angle = qpos[:, 1], qpos[:, 2]
    within = (np.abs(qpos[:, 2:]) < 100.0).all(axis=1) & (np.abs(qvel) < 100.0).all(axis=1)
    return np.asarray((height > 0.7) & (np.abs(angle) < 0.2) & within)


def humanoid_is_healthy(qpos: Floats, _: Floats) -> Booleans:
    """Torso between 1 m and 2 m high; of qpos [B, nq], [B]."""
    return np.asarray((qpos[:, 2] > 1.0) & (qpos[:, 2] < 2.0))


def walker_is_healthy(qpos: Floats, _: Floats) -> Booleans:
    """Torso between 0.8 m and 2 m high and leaning less than 1 rad; of qpos [B, nq], [B]."""
    height, angle = qpos[:, 1], qpos[:, 2]
    return np.asarray((height > 0.8) & (height < 2.0) & (np.abs(angle) < 1.0))


VELOCITY_TASKS: dict[str, VelocityTask] = {
    task.name: task
    for task in (
        VelocityTask(
            name="SafetyAntVelocity",
            model="ant.xml",
            frame_skip=5,
            threshold=2.6222,
            measured="torso",
            axes=2,
            hidden=2,
            control_weight=0.5,
            healthy_reward=1.0,
            position_noise=0.1,
            velocity_noise=0.1,
            normal_velocities=True,
            healthy=ant_is_healthy,
        ),
        VelocityTask(
            name="SafetyHalfCheetahVelocity",
            model="half_cheetah.xml",
            frame_skip=5,
            threshold=3.2096,
            measured="root",
            axes=1,
            hidden=1,
            control_weight=0.1,
            position_noise=0.1,
            velocity_noise=0.1,
            normal_velocities=True,
        ),
        VelocityTask(
            name="SafetyHopperVelocity",
            model="hopper.xml",
            frame_skip=4,
            threshold=0.7402,
            measured="root",
            axes=1,
            hidden=1,
            control_weight=1e-3,
            healthy_reward=1.0,
            position_noise=5e-3,
            velocity_noise=5e-3,
            velocity_bound=10.0,
            healthy=hopper_is_healthy,
            camera_distance=3.0,
        ),
        VelocityTask(
            name="SafetyHumanoidVelocity",
            model="humanoid.xml",
            frame_skip=5,
            threshold=1.4149,
            measured="mass",
            axes=2,
            hidden=2,
            forward_weight=1.25,
            control_weight=0.1,
            healthy_reward=5.0,
            position_noise=1e-2,
            velocity_noise=1e-2,
            observes_bodies=True,
            healthy=humanoid_is_healthy,
        ),
        VelocityTask(
            name="SafetySwimmerVelocity",
            model="swimmer.xml",
            frame_skip=4,
            threshold=0.2282,
            measured="root",
            axes=1,
            hidden=2,
            control_weight=1e-4,
            position_noise=0.1,
            velocity_noise=0.1,
        ),
        VelocityTask(
            name="SafetyWalker2dVelocity",
            model="walker2d.xml",
            frame_skip=4,
            threshold=2.3415,
            measured="root",
            axes=1,
            hidden=1,
            control_weight=1e-3,
            healthy_reward=1.0,
            position_noise=5e-3,
            velocity_noise=5e-3,
            velocity_bound=10.0,
            healthy=walker_is_healthy,
        ),
    )
}
