"""Environments of MuJoCo tasks: one for Gymnasium, and a batch for agents.

A family of tasks provides a ``TaskFamily``, which makes a ``Description`` and a batch (``EnvironmentBatch``);
the rest is here.

Notation: B environments, n observation components, m action components, k costs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.vector.utils import batch_space
from pydantic import BaseModel

from recrl.environments.cmdp import CMDPSpec, Floats, ObservationComponent
from recrl.environments.saved_state import IDENTITY, SavedState, identity
from recrl.environments.simulation.camera import Camera, Renderer
from recrl.environments.simulation.environment_batch import Booleans, EnvironmentBatch, Observations
from recrl.environments.vector import CMDPVectorEnv, masked_environments

Batch = EnvironmentBatch[Any, Any]


@dataclass(frozen=True)
class Description:
    """Description of a task for its environments.

    Attributes:
        name: of the task.
        observed: n.
        action_size: m.
        action_bound: actions are clipped to plus or minus this.
        cost_names: of the k costs.
        horizon: steps in an episode, at most.
        frames_per_second: environment steps per second of simulated time.
        components: the parts of an observation, in their order; empty if it is not divided.
        info: (result of a step) -> its ``info``, each value [B, ...].
        make_renderer: (batch) -> its renderer; a module-level function.
    """

    name: str
    observed: int
    action_size: int
    action_bound: float
    cost_names: tuple[str, ...]
    horizon: int
    frames_per_second: int
    info: Callable[[Any], dict[str, Any]]
    make_renderer: Callable[[Any], Renderer]
    components: tuple[ObservationComponent, ...] = ()

    @property
    def spaces(self) -> tuple[Box, Box]:
        """Return the spaces of observations and actions of one environment."""
        bound = self.action_bound
        return (
            Box(-np.inf, np.inf, (self.observed,), np.float32),
            Box(-bound, bound, (self.action_size,), np.float32),
        )

    @property
    def rendering(self) -> dict[str, Any]:
        """Return Gymnasium's metadata of rendering."""
        return {"render_modes": ["rgb_array"], "render_fps": self.frames_per_second}

    def act(self, batch: Batch, actions: npt.NDArray[Any], shape: tuple[int, ...]) -> None:
        """Set the actions of the next step, clipped to their bounds as Safety Gym does.

        Args:
            batch: the environments.
            actions: one for each environment, or for the only one.
            shape: required shape of the actions.

        Raises:
            ValueError: there was no reset, or the actions are invalid.
        """
        if not batch.generators:
            raise ValueError(f"{self.name}: call reset before the first step")
        actions = np.asarray(actions)
        if actions.shape != shape or actions.dtype.kind not in "fiu":
            raise ValueError(
                f"{self.name}: actions must be numbers of shape {shape}, "
                f"got {actions.dtype} of shape {actions.shape}"
            )
        if batch.set_actions(actions):
            return
        if not np.isfinite(actions).all():
            raise ValueError(f"{self.name}: actions must be finite, got {actions.tolist()}")
        batch.set_actions(np.clip(actions, -self.action_bound, self.action_bound))


@dataclass(frozen=True)
class TaskFamily:
    """Tasks with the same options and the same code.

    Attributes:
        tasks: their definitions, by name.
        options: the pydantic model of their options.
        make: (definition, number of environments B, options) -> a description and the batch.
    """

    tasks: Mapping[str, Any]
    options: type[BaseModel]
    make: Callable[[Any, int, Any], tuple[Description, Batch]]

    def make_batch(self, task: str, number: int, options: BaseModel) -> tuple[Description, Batch]:
        """Make the batch of a task by name.

        Raises:
            ValueError: there is no such task.
        """
        if task not in self.tasks:
            raise ValueError(f"task must be one of {', '.join(self.tasks)}, got {task!r}")
        return self.make(self.tasks[task], number, options)


class MujocoVectorEnv(CMDPVectorEnv):
    """B environments of one task, stepped together; a subclass for each family of tasks.

    Args:
        task: name of the task, for example ``CarGoal2``.
        num_envs: B, at least 1.
        render_mode: None or ``rgb_array``.
        options: the options of the family's tasks.

    Attributes:
        family: the tasks.
        options: as given, with defaults.
        batch: the environments.
    """

    family: ClassVar[TaskFamily]

    def __init__(self, task: str, num_envs: int = 1, render_mode: str | None = None, **options: Any) -> None:
        self.options = self.family.options(**options)
        description, self.batch = self.family.make_batch(task, num_envs, self.options)
        self._description = description
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._camera = Camera(render_mode, description.make_renderer)
        self.metadata = {
            **CMDPVectorEnv.metadata,
            **description.rendering,
        }
        self.single_observation_space, self.single_action_space = description.spaces
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.cmdp = CMDPSpec(
            description.name,
            self.single_observation_space,
            self.single_action_space,
            description.cost_names,
            description.horizon,
            description.components,
        )

    @classmethod
    def from_options(cls, name: str, num_envs: int, options: BaseModel) -> Self:
        """Make B environments of a task by its name, for the registry of tasks."""
        return cls(name, num_envs, **options.model_dump())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start new episodes in all environments, or in those of a ``reset_mask``.

        Args:
            seed: gives each of these environments a generator of its own.
            options: None, or ``reset_mask``, an array bool [B] with at least one True.

        Raises:
            TypeError: the mask is no array of booleans.
            ValueError: it is invalid, there are other options, or the first reset has a mask.
        """
        has_begun = bool(self.batch.generators)
        chosen = masked_environments(self.cmdp, self.num_envs, options, has_begun=has_begun)
        super().reset(seed=seed, options=options)
        if seed is not None or not self.batch.generators:
            self.batch.seed(seed, chosen)
        self.batch.restart(np.arange(self.num_envs) if chosen is None else chosen)
        return self.batch.observations(), {}

    def step(
        self, actions: npt.NDArray[Any]
    ) -> tuple[Observations, Floats, Booleans, Booleans, dict[str, Any]]:
        """Take one step in every environment; see ``recrl.environments.vector`` for what is returned."""
        batch = self.batch
        self._description.act(batch, actions, self.action_space.shape or ())
        outcome = batch.advance()
        observations = batch.observations()
        info = self._description.info(outcome)
        if len(outcome.finished):
            info["final_obs"] = observations
            info["_final_obs"] = outcome.terminated | outcome.truncated
            batch.restart(outcome.finished)
            observations = batch.observations()
        return observations, outcome.rewards, outcome.terminated, outcome.truncated, info

    def restart(self, index: npt.NDArray[np.intp]) -> Observations:
        """Begin new episodes in some environments; see ``recrl.environments.vector``."""
        if not self.batch.generators:
            raise ValueError(f"{self.cmdp.name}: call reset before restart")
        self.batch.restart(index)
        return self.batch.observations()

    def render(self) -> tuple[npt.NDArray[np.uint8], ...]:
        """Render one RGB frame of each environment, [height, width, 3]."""
        return self._camera.frames(self.batch)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the memory of the graphics driver."""
        self._camera.close()

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the future depends on: physics, counters, generators."""
        if not self.batch.generators:
            raise ValueError(f"{self.cmdp.name}: there is no state before reset")
        return {IDENTITY: identity(self.cmdp), **self.batch.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken.

        Raises:
            ValueError: the state is damaged, of another task, or of other options.
        """
        SavedState(f"{self.cmdp.name}: saved state", state).check_identity(self.cmdp)
        self.batch.load_state_dict(state)


class MujocoEnv(gymnasium.Env[Any, Any]):
    """One environment of a task; a subclass for each family of tasks.

    Args:
        task: name of the task, for example ``CarGoal2``.
        render_mode: None or ``rgb_array``.
        options: the options of the family's tasks.

    Attributes:
        family: the tasks.
        options: as given, with defaults.
        horizon: most steps of an episode.
        cost_names: names of the k costs in ``info["cost"]``, an array [k].
        observation_components: the parts of an observation, in their order.
        batch: a batch of one environment.
    """

    family: ClassVar[TaskFamily]
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(self, task: str, render_mode: str | None = None, **options: Any) -> None:
        self.options = self.family.options(**options)
        description, self.batch = self.family.make_batch(task, 1, self.options)
        self._description = description
        self.render_mode = render_mode
        self._camera = Camera(render_mode, description.make_renderer)
        self.metadata = {**self.metadata, **description.rendering}
        self.horizon = description.horizon
        self.cost_names = description.cost_names
        self.observation_components = description.components
        self.observation_space, self.action_space = description.spaces

    @classmethod
    def rendering(cls, name: str, options: BaseModel) -> Self:
        """Make a rendering environment of a task by its name, for the registry of tasks."""
        return cls(name, render_mode="rgb_array", **options.model_dump())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; it equals the first of a batch with the same seed."""
        super().reset(seed=seed, options=options)
        if seed is not None or not self.batch.generators:
            self.batch.seed(seed)
        self.batch.restart(np.arange(1))
        return self.batch.observations()[0], {}

    def step(self, action: npt.NDArray[Any]) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Take one step."""
        self._description.act(self.batch, action, self.action_space.shape or ())
        outcome = self.batch.advance()
        return (
            self.batch.observations()[0],
            float(outcome.rewards[0]),
            bool(outcome.terminated[0]),
            bool(outcome.truncated[0]),
            {name: values[0] for name, values in self._description.info(outcome).items()},
        )

    def render(self) -> npt.NDArray[np.uint8]:
        """Render an RGB frame, [height, width, 3]."""
        return self._camera.frames(self.batch)[0]

    def close(self) -> None:
        """Free the memory of the graphics driver."""
        self._camera.close()
