"""Every task by name: how to build it, its options, and its optimum if known.

A name is one of ``TASKS``, an entry point in the group ``recrl.tasks``, or an import path
``package.module:attribute``. The last two refer to a ``Task`` or to a callable. A callable takes the task's
options as keywords and returns one scalar Gymnasium environment with ``info["cost"]``.

The module that simulates a task is imported only when that task is requested.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict

from recrl.environments.cmdp import CostLimits
from recrl.environments.options import require_model
from recrl.environments.plugins import WrongKindError, load_attribute, resolve
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS
from recrl.environments.vector import CMDPVectorEnv
from recrl.environments.velocity.task_definitions import VELOCITY_TASKS

if TYPE_CHECKING:
    import gymnasium


class NotDrawnError(ValueError):
    """The task cannot be rendered."""


@dataclass(frozen=True)
class Task:
    """How to build one task. Strings are import paths ``package.module:attribute``, loaded when needed.

    Attributes:
        summary: one sentence of description.
        options: a frozen pydantic model of the options.
        make: callable (name, num_envs, options) -> CMDPVectorEnv.
        optimum: callable (name, options, limits) -> J*(d), or None if it is not known.
        drawn: callable (name, options) -> one scalar Gymnasium environment with ``info["cost"]`` that renders
            (``render_mode`` is ``rgb_array``), or None.
    """

    summary: str
    options: str | type[BaseModel]
    make: str | Callable[[str, int, Any], CMDPVectorEnv]
    optimum: str | Callable[[str, Any, CostLimits], float] | None = None
    drawn: str | Callable[[str, Any], gymnasium.Env[Any, Any]] | None = None


SAFETY_GYM = {
    "Goal": "drives to one goal after another",
    "Button": "touches the right one of four buttons",
    "Push": "pushes a box to one goal after another",
}
OBSTACLES = ("", ", past a few obstacles", ", past many obstacles")


def _two_state(costs: str) -> Task:
    module = "recrl.environments.finite.two_state"
    return Task(
        summary=f"A camp and a mine, {costs}, closed-form optimum: for testing learners.",
        options=f"{module}:TwoStateOptions",
        make=f"{module}:make_two_state",
        optimum=f"{module}:two_state_optimum",
    )


def _river_grid(summary: str, options: str = "RiverGridOptions") -> Task:
    module = "recrl.environments.rivergrid.grid_world"
    return Task(
        summary=summary,
        options=f"{module}:{options}",
        make=f"{module}:make_river_grid",
        optimum=f"{module}:river_grid_optimum",
        drawn="recrl.environments.rivergrid.minigrid_env:draw_river_grid",
    )


TASKS: dict[str, Task] = {
    "two-state": _two_state("one cost"),
    "two-state-2": _two_state("two costs"),
    "continuous-bandit": Task(
        summary="One continuous action, one cost, closed-form optimum: for testing Gaussian policies.",
        options="recrl.environments.continuous_bandit:ContinuousBanditOptions",
        make="recrl.environments.continuous_bandit:ContinuousBanditVectorEnv",
        optimum="recrl.environments.continuous_bandit:continuous_bandit_optimum",
    ),
    "rivergrid-1a": _river_grid(
        "Our version of the paper's RiverGrid 1a: the goal is only reached through the river, cost 5."
    ),
    "rivergrid-1b": _river_grid(
        "Our version of the paper's RiverGrid 1b: through the river, cost 5, or round it, cost 0."
    ),
    "rivergrid": _river_grid("RiverGrid on a map of your own.", "RiverGridMapOptions"),
    "rivergrid-generated": _river_grid(
        "RiverGrid on a random instance with the properties of the paper's two.", "RiverGridGeneratedOptions"
    ),
    "gymnasium": Task(
        summary="Any environment that is registered with Gymnasium, by its id.",
        options="recrl.environments.gymnasium_tasks:GymnasiumOptions",
        make="recrl.environments.gymnasium_tasks:make_gymnasium",
        drawn="recrl.environments.gymnasium_tasks:draw_gymnasium",
    ),
    **{
        name: Task(
            summary=f"Safety Gym: the {task.robot} {SAFETY_GYM[task.goal]}{OBSTACLES[task.level]}.",
            options="recrl.environments.safety_gym.safety_gym_environments:SafetyGymOptions",
            make="recrl.environments.safety_gym.safety_gym_environments:make_safety_gym",
            drawn="recrl.environments.safety_gym.safety_gym_environments:draw_safety_gym",
        )
        for name, task in SAFETY_TASKS.items()
    },
    **{
        name: Task(
            summary=f"Safety-Gymnasium: {task.robot} runs, at a cost of 1 in each step "
            f"above {task.threshold} m/s.",
            options="recrl.environments.velocity.velocity_environments:VelocityOptions",
            make="recrl.environments.velocity.velocity_environments:make_velocity",
            drawn="recrl.environments.velocity.velocity_environments:draw_velocity",
        )
        for name, task in VELOCITY_TASKS.items()
    },
}


class KeywordOptions(BaseModel):
    """Options of a task that is a plain callable: its keyword arguments."""

    model_config = ConfigDict(frozen=True, extra="allow")


def find_task(name: str) -> Task:
    """Return the task called ``name``.

    Raises:
        UnknownNameError: the name is not known; the message names the nearest known task.
        WrongKindError: the named object is neither a Task nor callable.
    """
    found = resolve(name, kind="task", group="recrl.tasks", ours=TASKS)
    if isinstance(found, Task):
        return found
    if not callable(found):
        raise WrongKindError(
            f"task {name!r} must be a Task or return an environment, got {type(found).__name__}"
        )
    from recrl.environments.gymnasium_tasks import (  # noqa: PLC0415  # only if a task needs it
        draw_from_callable,
        keywords_of,
        make_from_callable,
    )

    return Task(
        summary=f"The environment that {name} returns. Keyword arguments: {keywords_of(found)}.",
        options=KeywordOptions,
        make=functools.partial(make_from_callable, found),
        drawn=functools.partial(draw_from_callable, found),
    )


def task_options(name: str, options: Mapping[str, Any]) -> BaseModel:
    """Return the validated options of a task with defaults; their ``model_dump`` is canonical.

    Raises:
        UnknownNameError: the task is not known.
        pydantic.ValidationError: all mistakes in the options at once.
    """
    return options_model(name).model_validate(dict(options))


def options_model(name: str) -> type[BaseModel]:
    """Return the pydantic model of a task's options.

    Raises:
        UnknownNameError: the task is not known.
        TypeError: it is no pydantic model.
    """
    model: type[BaseModel] = _loaded(find_task(name).options)
    require_model(model)
    return model


def make_vector(name: str, num_envs: int, *, options: Mapping[str, Any] | None = None) -> CMDPVectorEnv:
    """Make B = ``num_envs`` environments of a task; ``reset(seed=...)`` seeds them.

    Args:
        name: a name of ours, an entry point's name, or ``package.module:attribute``.
        num_envs: B, at least 1.
        options: the task's settings, validated by its options model.
    """
    task = find_task(name)
    environment: CMDPVectorEnv = _loaded(task.make)(name, num_envs, task_options(name, options or {}))
    return environment


def make_drawn(name: str, *, options: Mapping[str, Any] | None = None) -> gymnasium.Env[Any, Any]:
    """Make one rendering environment of a task: ``render()`` returns uint8 [height, width, 3].

    A user's environment that does not render RGB is made without, and ``render()`` returns what it likes.

    Raises:
        NotDrawnError: the task cannot be rendered.
    """
    task = find_task(name)
    if task.drawn is None:
        raise NotDrawnError(f"the task {name} cannot be rendered")
    environment: gymnasium.Env[Any, Any] = _loaded(task.drawn)(name, task_options(name, options or {}))
    return environment


def optimal_return(name: str, options: Mapping[str, Any], limits: CostLimits | npt.ArrayLike) -> float | None:
    """Return J*(d), the largest expected undiscounted return under limits d.

    Args:
        name: of the task, as for ``make_vector``.
        options: the task's settings.
        limits: d, undiscounted cost per episode, [k]: a number, a list of numbers or ``CostLimits``.

    Returns:
        The constrained optimum; None if it is not known, and -inf if no policy keeps the limits.

    Raises:
        UnknownNameError: the task is not known.
        ValueError: an option is wrong, or the limits are not one number per cost.
    """
    task = find_task(name)
    if task.optimum is None:
        return None
    canonical = task_options(name, options).model_dump_json()
    return _cached_optimum(name, canonical, _cost_limits(limits))


def _cost_limits(given: CostLimits | npt.ArrayLike) -> CostLimits:
    """Return limits as ``CostLimits``.

    Raises:
        ValueError: they are not numbers of at least 0.
    """
    if isinstance(given, CostLimits):
        return given
    try:
        values = np.asarray(given, np.float64).ravel()
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"limits must be a number, a list of numbers or CostLimits, got {given!r}"
        ) from error
    return CostLimits(tuple(values))


@functools.lru_cache(maxsize=4096)
def _cached_optimum(name: str, canonical: str, limits: CostLimits) -> float:
    task = find_task(name)
    return float(_loaded(task.optimum)(name, task_options(name, json.loads(canonical)), limits))


def _loaded(reference: Any) -> Any:
    return load_attribute(reference) if isinstance(reference, str) else reference
