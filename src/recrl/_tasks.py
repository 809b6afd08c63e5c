"""The tasks in Python, as vector environments and as single Gymnasium environments."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from recrl.environments.plugins import UnknownNameError, modules_here
from recrl.environments.registry import NotDrawnError, make_drawn, make_vector, options_model
from recrl.orchestrator.errors import USERS_ERRORS, RecrlError, described
from recrl.orchestrator.validation_sentences import sentences

if TYPE_CHECKING:
    import gymnasium

    from recrl.environments.vector import CMDPVectorEnv


def make(task: str, /, num_envs: int = 1, **options: Any) -> CMDPVectorEnv:
    """Make a task as a Gymnasium vector environment.

    Args:
        task: its name (``recrl-sweep list tasks``), or ``package.module:attribute``.
        num_envs: B, number of environments, at least 1.
        **options: of the task (``recrl-sweep options TASK``).

    Returns:
        A vector environment. ``step(actions)`` takes actions [B] or [B, m]. It returns observations [B, n],
        rewards [B], terminated [B], truncated [B] and ``info``; ``info["cost"]`` holds each step's costs,
        [B, k]. An environment whose episode ended is reset in the same step, and ``info["final_obs"]`` has
        the last observation. ``cmdp`` describes the task.

    Raises:
        RecrlError: there is no such task, an option is wrong, or the task's own code raises an error.

    Example:
        >>> import recrl
        >>> envs = recrl.make("rivergrid-1a", 4, horizon=100)
        >>> observations, info = envs.reset(seed=0)
        >>> observations.shape[0], envs.cmdp.cost_names
        (4, ('river',))
    """
    with modules_here():
        _check(task, options)
        with _made(task):
            return make_vector(task, num_envs, options=options)


def make_env(task: str, /, **options: Any) -> gymnasium.Env[Any, Any]:
    """Make a task as one Gymnasium environment, with rendering (``render()`` is RGB).

    Args:
        task: as for ``make``.
        **options: of the task.

    Returns:
        An environment with flat observations [n], which a policy's ``act`` takes. ``info["cost"]`` holds each
        step's costs, [k]. Your own environment can render if it takes the keyword ``render_mode``.

    Raises:
        RecrlError: there is no such task, an option is wrong, or the task exists as a vector only.

    Example:
        >>> import recrl
        >>> env = recrl.make_env("rivergrid-1a")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(0)
        >>> info["cost"]
        array([0.])
    """
    from gymnasium.spaces import Box  # noqa: PLC0415

    from recrl.environments.gymnasium_tasks import CostArrays, FlatObservations  # noqa: PLC0415

    try:
        with modules_here(), _made(task):
            _check(task, options)
            environment = make_drawn(task, options=options)
    except NotDrawnError as error:
        raise RecrlError(f"the task {task} is no single environment; use recrl.make({task!r})") from error
    space = environment.observation_space
    is_flat = isinstance(space, Box) and len(space.shape) == 1
    return CostArrays(environment if is_flat else FlatObservations(environment))


@contextmanager
def _made(task: str) -> Iterator[None]:
    """Say of an error in a task's code which task it is."""
    try:
        yield
    except (NotDrawnError, RecrlError):
        raise
    except USERS_ERRORS as error:
        raise RecrlError(f"the task {task} cannot be made: {described(error)}") from error


def _check(task: str, options: dict[str, Any]) -> None:
    """Report all mistakes in the options, as the check of a grid does."""
    try:
        model = options_model(task)
        model.model_validate(options)
    except UnknownNameError as error:
        raise RecrlError(str(error)) from error
    except ValidationError as error:
        problems = [
            f"{'.'.join(map(str, place)) or 'the options'}: {sentence}"
            for place, sentence in sentences(error, model)
        ]
        raise RecrlError("; ".join(f"{task}: {problem}" for problem in problems)) from error
    except USERS_ERRORS as error:
        raise RecrlError(f"the task {task} cannot be used: {described(error)}") from error
