"""The velocity tasks as environments: one for Gymnasium, and a batch for agents.

    import gymnasium
    environment = gymnasium.make("recrl.environments.registration:recrl/SafetyAntVelocity-v1")
    batch = gymnasium.make_vec("recrl.environments.registration:recrl/SafetyAntVelocity-v1", num_envs=16)

Observations, actions, rewards and costs: see ``recrl.environments.velocity.velocity_batch``.

``info`` of a step holds ``cost`` (the cost, [k] with k = 1), ``velocity`` (which is compared with the
threshold, m/s), and ``cost_exception`` if the physics diverged.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from recrl.environments.options import Options
from recrl.environments.simulation.camera import Renderer
from recrl.environments.simulation.mujoco_environments import (
    Description,
    MujocoEnv,
    MujocoVectorEnv,
    TaskFamily,
)
from recrl.environments.velocity.task_definitions import HORIZON, VELOCITY_TASKS, VelocityTask

if TYPE_CHECKING:
    from recrl.environments.velocity.velocity_batch import VelocityBatch, VelocityOutcome

COST_NAMES = ("cost",)


class VelocityOptions(Options):
    """Settings of all velocity tasks."""

    horizon: int = Field(
        default=HORIZON, ge=1, le=HORIZON, description="Steps in an episode (safety-gymnasium: 1,000)."
    )
    num_threads: int = Field(
        default=1, ge=1, le=256, description="Threads for the physics (ours); results do not depend on it."
    )


def _info(outcome: VelocityOutcome) -> dict[str, Any]:
    info: dict[str, Any] = {"cost": outcome.costs[:, None], "velocity": outcome.velocities}
    if outcome.broken is not None:
        info["cost_exception"] = outcome.broken.astype(np.float64)
    return info


def _renderer(batch: VelocityBatch) -> Renderer:
    from recrl.environments.velocity.rendering import VelocityRenderer  # noqa: PLC0415  # needs graphics

    return VelocityRenderer(batch)


def _make(task: VelocityTask, number: int, options: VelocityOptions) -> tuple[Description, VelocityBatch]:
    """Make the description and the batch of a task; only this function imports MuJoCo."""
    from recrl.environments.velocity.velocity_batch import VelocityBatch  # noqa: PLC0415

    batch = VelocityBatch(task, number, horizon=options.horizon, num_threads=options.num_threads)
    description = Description(
        name=task.name,
        observed=batch.observed,
        action_size=batch.model.nu,
        action_bound=batch.bound,
        cost_names=COST_NAMES,
        horizon=options.horizon,
        frames_per_second=round(1.0 / batch.seconds),
        info=_info,
        make_renderer=_renderer,
    )
    return description, batch


VELOCITY = TaskFamily(VELOCITY_TASKS, VelocityOptions, _make)


class VelocityVectorEnv(MujocoVectorEnv):
    """B environments of one velocity task, for example ``SafetyAntVelocity``, stepped together."""

    family = VELOCITY
    batch: VelocityBatch


class VelocityEnv(MujocoEnv):
    """One environment of a velocity task, for example ``SafetyAntVelocity``."""

    family = VELOCITY
    batch: VelocityBatch


make_velocity = VelocityVectorEnv.from_options
draw_velocity = VelocityEnv.rendering
