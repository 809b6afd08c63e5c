"""Safety Gym's tasks as environments: one for Gymnasium, and a batch for agents.

    import gymnasium
    environment = gymnasium.make("recrl.environments.registration:recrl/CarGoal2-v0")
    environments = gymnasium.make_vec("recrl.environments.registration:recrl/CarGoal2-v0", num_envs=16)

The eighteen tasks are ``recrl/CarGoal0-v0`` to ``recrl/PointPush2-v0``. Observations, actions, rewards and
costs: see ``recrl.environments.safety_gym.safety_gym_batch``.

``info`` of a step holds ``cost`` (the k costs), the indicator of every cost term (``cost_hazards``,
``cost_vases_contact``, ...), ``goal_met``, and ``cost_exception`` if the physics diverged.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from recrl.environments.cmdp import ObservationComponent
from recrl.environments.options import Options
from recrl.environments.safety_gym.task_definitions import (
    HORIZON,
    LIDAR_RANGE,
    SAFETY_TASKS,
    SUBSTEPS,
    SafetyTask,
)
from recrl.environments.simulation.camera import Renderer
from recrl.environments.simulation.mujoco_environments import (
    Description,
    MujocoEnv,
    MujocoVectorEnv,
    TaskFamily,
)

if TYPE_CHECKING:
    from recrl.environments.safety_gym.safety_gym_batch import SafetyGymBatch, SafetyGymOutcome


class SafetyGymOptions(Options):
    """Settings of all Safety Gym tasks."""

    cost: Literal["indicator", "per_hazard"] = Field(
        default="indicator",
        description=(
            "indicator: one cost, 1 in a step in which any cost term is 1 (the paper's). per_hazard: one "
            "cost for each cost term, hazards among them (CarGoal2: hazards, vases_contact, vases_velocity)."
        ),
    )
    horizon: int = Field(
        default=HORIZON, ge=1, le=HORIZON, description="Steps in an episode (Safety Gym: 1,000)."
    )
    num_threads: int = Field(
        default=1, ge=1, le=256, description="Threads for the physics (ours); results do not depend on it."
    )


def cost_names(task: SafetyTask, options: SafetyGymOptions) -> tuple[str, ...]:
    """The names of the k costs.

    Raises:
        ValueError: one cost per term is requested of a task without cost terms.
    """
    if options.cost == "indicator":
        return ("cost",)
    if not task.cost_terms:
        raise ValueError(
            f"{task.name}: cost must be 'indicator', as nothing costs at level 0, got 'per_hazard'"
        )
    return task.cost_terms


def observation_components(task: SafetyTask) -> tuple[ObservationComponent, ...]:
    """Return the parts of a task's observation: the robot's sensors, and a lidar for each kind of object."""
    return tuple(
        ObservationComponent(name, size, LIDAR_RANGE if name.endswith("_lidar") else None)
        for name, size in task.components
    )


def _info(terms: tuple[str, ...], cost: str, outcome: SafetyGymOutcome) -> dict[str, Any]:
    info: dict[str, Any] = {term: outcome.terms[row] for row, term in enumerate(terms)}
    info["cost"] = (outcome.terms.copy() if cost == "per_hazard" else outcome.costs).T
    info["goal_met"] = outcome.goal_met
    if outcome.broken is not None:
        info["cost_exception"] = outcome.broken.astype(np.float64)
    return info


def _renderer(batch: SafetyGymBatch) -> Renderer:
    from recrl.environments.safety_gym.rendering import SafetyRenderer  # noqa: PLC0415  # needs graphics

    return SafetyRenderer(batch)


def frames_per_second(task: SafetyTask) -> int:
    """Environment steps per second of simulated time: 25 for the Car, 50 for the Point."""
    return round(1.0 / (task.timestep * SUBSTEPS))


def _make(task: SafetyTask, number: int, options: SafetyGymOptions) -> tuple[Description, SafetyGymBatch]:
    """Make the description and the batch of a task; only this function imports MuJoCo and Numba."""
    from recrl.environments.safety_gym.safety_gym_batch import SafetyGymBatch  # noqa: PLC0415

    description = Description(
        name=task.name,
        observed=task.observation_size,
        action_size=2,
        action_bound=1.0,
        cost_names=cost_names(task, options),
        horizon=options.horizon,
        frames_per_second=frames_per_second(task),
        info=partial(_info, tuple(f"cost_{term}" for term in task.cost_terms), options.cost),
        make_renderer=_renderer,
        components=observation_components(task),
    )
    return description, SafetyGymBatch(task, number, horizon=options.horizon, num_threads=options.num_threads)


SAFETY_GYM = TaskFamily(SAFETY_TASKS, SafetyGymOptions, _make)


class SafetyGymVectorEnv(MujocoVectorEnv):
    """B environments of one Safety Gym task, for example ``CarGoal2``, stepped together."""

    family = SAFETY_GYM
    batch: SafetyGymBatch


class SafetyGymEnv(MujocoEnv):
    """One environment of a Safety Gym task, for example ``CarGoal2``."""

    family = SAFETY_GYM
    batch: SafetyGymBatch


make_safety_gym = SafetyGymVectorEnv.from_options
draw_safety_gym = SafetyGymEnv.rendering
