"""The velocity tasks as environments: one for Gymnasium, and a batch for agents.

    import gymnasium
    environment = gymnasium.make("recrl.environments.registration:recrl/SafetyAntVelocity-v1")
    batch = gymnasium.make_vec("recrl.environments.registration:recrl/SafetyAntVelocity-v1", num_envs=16)

What is observed, done, earned and paid: ``recrl.environments.velocity.batch``.

``info`` of a step holds ``cost`` (the cost, [k] with k = 1), ``velocity`` (what is compared with the
threshold, m/s), and ``cost_exception`` if the physics broke down.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from pydantic import BaseModel, ConfigDict, Field

from recrl.environments.cmdp import CMDPSpec, Floats
from recrl.environments.simulation.actions import give_actions
from recrl.environments.simulation.camera import Camera, Renderer
from recrl.environments.vector import CMDPVectorEnv
from recrl.environments.velocity.tasks import HORIZON, VELOCITY_TASKS, Booleans, VelocityTask

if TYPE_CHECKING:
    from recrl.environments.velocity.batch import Observations, Outcome, VelocityWorlds

COST_NAMES = ("cost",)


class VelocityOptions(BaseModel):
    """Settings of all velocity tasks."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    horizon: int = Field(
        default=HORIZON, ge=1, le=HORIZON, description="Steps in an episode (safety-gymnasium: 1,000)."
    )
    out_of_range: Literal["error", "clip"] = Field(
        default="error", description="Refuse actions outside their bounds, or clip them; agents clip theirs."
    )
    num_threads: int = Field(
        default=1, ge=1, le=256, description="Threads for the physics (ours); results do not depend on it."
    )


def _make_worlds(task: VelocityTask, number: int, options: VelocityOptions) -> VelocityWorlds:
    """Worlds to be stepped; who only asks what there is to be set does not wait for MuJoCo and Numba."""
    from recrl.environments.velocity.batch import VelocityWorlds  # noqa: PLC0415

    return VelocityWorlds(task, number, horizon=options.horizon, num_threads=options.num_threads)


def _find(task: str) -> VelocityTask:
    if task not in VELOCITY_TASKS:
        raise ValueError(f"task must be one of {', '.join(VELOCITY_TASKS)}, got {task!r}")
    return VELOCITY_TASKS[task]


def _spaces(worlds: VelocityWorlds) -> tuple[Box, Box]:
    """Of the observations and of the actions of one environment."""
    bound = worlds.bound
    return (
        Box(-np.inf, np.inf, (worlds.observed,), np.float32),
        Box(-bound, bound, (worlds.model.nu,), np.float32),
    )


def _order(
    worlds: VelocityWorlds, actions: npt.NDArray[Any], shape: tuple[int, ...], options: VelocityOptions
) -> None:
    """Give the worlds their actions, or say in a sentence what is wrong with them."""
    name = worlds.task.name
    if not worlds.generators:
        raise ValueError(f"{name}: call reset before the first step")
    out_of_range = options.out_of_range
    give_actions(name, worlds, actions, shape=shape, bound=worlds.bound, out_of_range=out_of_range)


def _info(outcome: Outcome) -> dict[str, Any]:
    info: dict[str, Any] = {"cost": outcome.costs[:, None], "velocity": outcome.velocities}
    if outcome.broken is not None:
        info["cost_exception"] = outcome.broken.astype(np.float64)
    return info


def _renderer(worlds: VelocityWorlds) -> Renderer:
    from recrl.environments.velocity.rendering import VelocityRenderer  # noqa: PLC0415  # needs graphics

    return VelocityRenderer(worlds)


def _frames_per_second(worlds: VelocityWorlds) -> int:
    """Steps in a second of the robot's time."""
    return round(1.0 / worlds.seconds)


class VelocityVectorEnv(CMDPVectorEnv):
    """B environments of one velocity task, stepped together.

    Args:
        task: for example ``SafetyAntVelocity``.
        num_envs: B, at least 1.
        render_mode: None or ``rgb_array``.
        options: the fields of ``VelocityOptions``.

    Attributes:
        worlds: what is stepped.
    """

    def __init__(self, task: str, num_envs: int = 1, render_mode: str | None = None, **options: Any) -> None:
        found = _find(task)
        if num_envs < 1:
            raise ValueError(f"{task}: num_envs must be at least 1, got {num_envs}")
        self.options = VelocityOptions(**options)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._camera = Camera(render_mode, _renderer)
        self.worlds = _make_worlds(found, num_envs, self.options)
        self.metadata = {
            **CMDPVectorEnv.metadata,
            "autoreset_mode": AutoresetMode.SAME_STEP,
            "render_modes": ["rgb_array"],
            "render_fps": _frames_per_second(self.worlds),
        }
        self.single_observation_space, self.single_action_space = _spaces(self.worlds)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.cmdp = CMDPSpec(
            task, self.single_observation_space, self.single_action_space, COST_NAMES, self.options.horizon
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start B episodes; ``seed`` gives each environment a generator of its own."""
        super().reset(seed=seed, options=options)
        if seed is not None or not self.worlds.generators:
            self.worlds.seed(seed)
        self.worlds.restart(np.arange(self.num_envs))
        return self.worlds.observations(), {}

    def step(
        self, actions: npt.NDArray[Any]
    ) -> tuple[Observations, Floats, Booleans, Booleans, dict[str, Any]]:
        """Take one step in every environment; see ``recrl.environments.vector`` for what is returned."""
        worlds = self.worlds
        _order(worlds, actions, self.action_space.shape or (), self.options)
        outcome = worlds.advance()
        observations = worlds.observations()
        info = _info(outcome)
        if len(outcome.finished):
            info["final_obs"] = observations
            worlds.restart(outcome.finished)
            observations = worlds.observations()
        return observations, outcome.rewards, outcome.terminated, outcome.truncated, info

    def restart(self, index: npt.NDArray[np.intp]) -> Observations:
        """Begin new episodes in some environments; see ``recrl.environments.vector``."""
        if not self.worlds.generators:
            raise ValueError(f"{self.cmdp.name}: call reset before restart")
        self.worlds.restart(index)
        return self.worlds.observations()

    def render(self) -> tuple[npt.NDArray[np.uint8], ...]:
        """One RGB picture of each environment, [height, width, 3]."""
        return self._camera.frames(self.worlds)

    def close_extras(self, **kwargs: Any) -> None:
        """Free what drawing needed."""
        self._camera.close()

    def state_dict(self) -> dict[str, Any]:
        """Physics, where the robots were measured, counters and generators."""
        if not self.worlds.generators:
            raise ValueError(f"{self.cmdp.name}: there is no state before reset")
        return self.worlds.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self.worlds.load_state_dict(state)


class VelocityEnv(gymnasium.Env[Any, Any]):
    """One environment of a velocity task.

    Args:
        task: for example ``SafetyAntVelocity``.
        render_mode: None or ``rgb_array``.
        options: the fields of ``VelocityOptions``.

    Attributes:
        cost_names: names of the k costs in ``info["cost"]``, an array [k].
        worlds: what is stepped: a single robot.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, task: str, render_mode: str | None = None, **options: Any) -> None:
        self.options = VelocityOptions(**options)
        self.render_mode = render_mode
        self._camera = Camera(render_mode, _renderer)
        self.cost_names = COST_NAMES
        self.worlds = _make_worlds(_find(task), 1, self.options)
        self.metadata = {**self.metadata, "render_fps": _frames_per_second(self.worlds)}
        self.observation_space, self.action_space = _spaces(self.worlds)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start an episode; the same seed gives the same episode as the first of a batch."""
        super().reset(seed=seed, options=options)
        if seed is not None or not self.worlds.generators:
            self.worlds.seed(seed)
        self.worlds.restart(np.arange(1))
        return self.worlds.observations()[0], {}

    def step(self, action: npt.NDArray[Any]) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Take one step."""
        _order(self.worlds, action, self.action_space.shape or (), self.options)
        outcome = self.worlds.advance()
        return (
            self.worlds.observations()[0],
            float(outcome.rewards[0]),
            bool(outcome.terminated[0]),
            bool(outcome.truncated[0]),
            {name: values[0] for name, values in _info(outcome).items()},
        )

    def render(self) -> npt.NDArray[np.uint8]:
        """An RGB picture, [height, width, 3]."""
        return self._camera.frames(self.worlds)[0]

    def close(self) -> None:
        """Free what drawing needed."""
        self._camera.close()


def make_velocity(name: str, num_envs: int, options: VelocityOptions) -> VelocityVectorEnv:
    """B environments of a task by its name, for the registry of tasks."""
    return VelocityVectorEnv(name, num_envs, **options.model_dump())


def draw_velocity(name: str, options: VelocityOptions) -> VelocityEnv:
    """A task that draws itself, by its name, for the registry of tasks."""
    return VelocityEnv(name, render_mode="rgb_array", **options.model_dump())
