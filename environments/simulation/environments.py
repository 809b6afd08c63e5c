"""Environments of MuJoCo tasks: one for Gymnasium, and a batch for agents.

A family of tasks provides a ``Description`` and a batch (``EnvironmentBatch``); the rest is here.

Notation: B environments, n observation components, m action components, k costs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from recrl.environments.cmdp import CMDPSpec, Floats, ObservationComponent
from recrl.environments.simulation.actions import give_actions
from recrl.environments.simulation.camera import Camera, Renderer
from recrl.environments.simulation.environment_batch import Booleans, EnvironmentBatch, Observations
from recrl.environments.vector import CMDPVectorEnv

Batch = EnvironmentBatch[Any, Any]


@dataclass(frozen=True)
class Description:
    """Description of a task for its environments.

    Attributes:
        name: of the task.
        observed: n.
        action_size: m.
        action_bound: actions are within plus or minus this.
        out_of_range: treatment of other finite actions.
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
    out_of_range: Literal["error", "clip"]
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
        """Set the actions of the next step.

        Raises:
            ValueError: there was no reset, or the actions are invalid.
        """
        if not batch.generators:
            raise ValueError(f"{self.name}: call reset before the first step")
        bound, out_of_range = self.action_bound, self.out_of_range
        give_actions(self.name, batch, actions, shape=shape, bound=bound, out_of_range=out_of_range)


class MujocoVectorEnv(CMDPVectorEnv):
    """B environments of one task, stepped together.

    Args:
        description: of the task.
        batch: the environments.
        render_mode: None or ``rgb_array``.

    Attributes:
        batch: as given.
    """

    def __init__(self, description: Description, batch: Batch, render_mode: str | None) -> None:
        self._description = description
        self.batch = batch
        self.num_envs = batch.number
        self.render_mode = render_mode
        self._camera = Camera(render_mode, description.make_renderer)
        self.metadata = {
            **CMDPVectorEnv.metadata,
            "autoreset_mode": AutoresetMode.SAME_STEP,
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

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start B episodes; ``seed`` gives each environment a generator of its own."""
        super().reset(seed=seed, options=options)
        if seed is not None or not self.batch.generators:
            self.batch.seed(seed)
        self.batch.restart(np.arange(self.num_envs))
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
        return self.batch.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self.batch.load_state_dict(state)


class MujocoEnv(gymnasium.Env[Any, Any]):
    """One environment of a task.

    Args:
        description: of the task.
        batch: a batch of one environment.
        render_mode: None or ``rgb_array``.

    Attributes:
        cost_names: names of the k costs in ``info["cost"]``, an array [k].
        observation_components: the parts of an observation, in their order.
        batch: as given.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(self, description: Description, batch: Batch, render_mode: str | None) -> None:
        self._description = description
        self.batch = batch
        self.render_mode = render_mode
        self._camera = Camera(render_mode, description.make_renderer)
        self.metadata = {**self.metadata, **description.rendering}
        self.cost_names = description.cost_names
        self.observation_components = description.components
        self.observation_space, self.action_space = description.spaces

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
