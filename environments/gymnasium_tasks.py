"""Tasks made of Gymnasium environments: the task ``gymnasium``, of a registered id, and a user's callables.

``gymnasium_adapter`` steps them; here they are made, for training and for films.
"""

from __future__ import annotations

import functools
import inspect
import logging
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator
from pydantic import BaseModel, Field, JsonValue, field_validator

from recrl.environments.gymnasium_adapter import (
    Environment,
    SyncCMDPVectorEnv,
    made_environment,
    names_of_costs,
)
from recrl.environments.options import Options
from recrl.environments.plugins import check_keywords, import_module, require_trust

logger = logging.getLogger("recrl.environments")


class GymnasiumOptions(Options):
    """Settings of the task ``gymnasium``."""

    id: str = Field(description="The id registered with Gymnasium, or module:id to import the module first.")
    keywords: dict[str, JsonValue] = Field(
        default_factory=dict, description="Keyword arguments for gymnasium.make."
    )
    cost_names: tuple[str, ...] | None = Field(
        default=None,
        min_length=1,
        description="Names of the costs in info['cost']; by default the environment's cost_names, else cost.",
    )
    costless: bool = Field(
        default=False,
        description="Whether to report costs of 0. Costs that the environment reports are ignored.",
    )

    @field_validator("id")
    @classmethod
    def _registered(cls, identifier: str) -> str:
        module, separator, registered = identifier.rpartition(":")
        if separator and not module.startswith("recrl.environments."):
            require_trust(identifier)
        try:
            if separator:
                import_module(module)
            gymnasium.spec(registered)
        except (gymnasium.error.NameNotFound, gymnasium.error.NamespaceNotFound) as error:
            hint = "" if separator else f" If a module of yours registers it, write my_module:{identifier}"
            raise ValueError(f"{error}{hint}") from error
        except (gymnasium.error.Error, ImportError, ValueError) as error:
            raise ValueError(str(error)) from error
        except SystemExit as error:
            raise ValueError(f"importing {module} ends the process (exit code {error.code})") from error
        return identifier


def make_gymnasium(name: str, num_envs: int, options: GymnasiumOptions) -> SyncCMDPVectorEnv:
    """B environments of a registered id."""
    keywords: dict[str, Any] = dict(options.keywords)
    _check_keywords_of_id(options)
    factory = functools.partial(gymnasium.make, options.id, disable_env_checker=True, **keywords)
    return SyncCMDPVectorEnv(
        name, [factory] * num_envs, cost_names=options.cost_names, costless=options.costless
    )


def _check_keywords_of_id(options: GymnasiumOptions) -> None:
    """Check the keywords as far as the class's signature says; ``gymnasium.make`` takes some itself.

    Raises:
        ValueError: the class does not take one of them, or recrl gives it.
    """
    if ours := {"id", "disable_env_checker"} & options.keywords.keys():
        raise ValueError(f"keywords: {min(ours)} is given by recrl; leave it out")
    entry = gymnasium.spec(options.id.rpartition(":")[2]).entry_point
    creator = load_env_creator(entry) if isinstance(entry, str) else entry
    own = inspect.signature(gymnasium.make).parameters
    if creator is not None:
        others = {key: value for key, value in options.keywords.items() if key not in own}
        check_keywords(creator, options.id, others, called="keyword")


def keywords_of(factory: Callable[..., Environment]) -> str:
    """Return the keyword arguments of a user's callable and their defaults, as text."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):  # builtins have none
        return "unknown"
    named = [it for it in parameters if it.kind not in (it.VAR_POSITIONAL, it.POSITIONAL_ONLY)]
    settings = [it for it in named if it.name != "render_mode"]  # recrl gives it, for films
    return (
        ", ".join(it.name if it.default is it.empty else f"{it.name}={it.default!r}" for it in settings)
        or "none"
    )


def make_from_callable(
    factory: Callable[..., Environment], name: str, num_envs: int, options: BaseModel
) -> SyncCMDPVectorEnv:
    """B environments of a user's callable, which takes the options as keywords.

    Raises:
        ValueError: the callable does not take an option.
    """
    check_keywords(factory, name, options.model_dump())
    return SyncCMDPVectorEnv(name, [functools.partial(factory, **options.model_dump())] * num_envs)


def draw_gymnasium(name: str, options: GymnasiumOptions) -> Environment:
    """Return an environment of a registered id; it renders RGB if it can, or as its ``keywords`` say."""
    make = functools.partial(gymnasium.make, options.id, disable_env_checker=True)
    environment = _rendering(make, dict(options.keywords))
    if not options.costless:
        return environment
    return _Costless(environment, len(names_of_costs(name, environment, options.cost_names)))


def draw_from_callable(factory: Callable[..., Environment], name: str, options: BaseModel) -> Environment:
    """Return an environment of a user's callable; it renders RGB if it can, or as the options say.

    Raises:
        ValueError: the callable does not take an option, or returns something else.
    """
    keywords = options.model_dump()
    check_keywords(factory, name, keywords)
    return _rendering(lambda **given: made_environment(name, functools.partial(factory, **given)), keywords)


def _rendering(make: Callable[..., Environment], keywords: dict[str, Any]) -> Environment:
    """Make an environment with rendering; where it refuses ``render_mode`` in whatever way, without.

    The reason is logged. It may be a missing library.
    """
    if "render_mode" in keywords:
        return make(**keywords)
    try:
        return make(**keywords, render_mode="rgb_array")
    except Exception as error:  # environments refuse in different ways
        environment = make(**keywords)
        logger.warning("%s does not render RGB: %s: %s", environment, type(error).__name__, error)
        return environment


class FlatObservations(gymnasium.ObservationWrapper[Any, Any, Any]):
    """Gymnasium's ``FlattenObservation``, but it can be pickled."""

    def __init__(self, environment: Environment) -> None:
        super().__init__(environment)
        self.observation_space = gymnasium.spaces.flatten_space(environment.observation_space)

    def observation(self, observation: Any) -> Any:
        """Flatten an observation."""
        return gymnasium.spaces.flatten(self.env.observation_space, observation)


class CostArrays(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Wrapper with ``info["cost"]`` as an array [k], also if the environment reports a number."""

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step; convert its costs."""
        observation, reward, terminated, truncated, info = super().step(action)
        costs = {"cost": np.array(info["cost"], np.float64).reshape(-1)} if "cost" in info else {}
        return observation, reward, terminated, truncated, {**info, **costs}


class _Costless(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Wrapper that reports a cost of 0 for each of ``num_costs`` costs."""

    def __init__(self, environment: Environment, num_costs: int) -> None:
        super().__init__(environment)
        self._num_costs = num_costs

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, {**info, "cost": np.zeros(self._num_costs)}
