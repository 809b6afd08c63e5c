"""Safety Gym's tasks as environments: one for Gymnasium, and a batch for agents.

    import gymnasium
    environment = gymnasium.make("recrl.environments.registration:recrl/CarGoal2-v0")
    environments = gymnasium.make_vec("recrl.environments.registration:recrl/CarGoal2-v0", num_envs=16)

The eighteen tasks are ``recrl/CarGoal0-v0`` to ``recrl/PointPush2-v0``. What is observed, done, earned and
paid: ``recrl.environments.safety_gym.batch``.

``info`` of a step holds ``cost`` (the k costs), the indicator of every cost term (``cost_hazards``,
``cost_vases_contact``, ...), ``goal_met``, and ``cost_exception`` if the physics broke down.
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

from recrl.environments.cmdp import CMDPSpec, Floats, ObservationComponent
from recrl.environments.safety_gym.tasks import HORIZON, LIDAR_RANGE, SAFETY_TASKS, SUBSTEPS, SafetyTask
from recrl.environments.simulation.actions import give_actions
from recrl.environments.simulation.camera import Camera, Renderer
from recrl.environments.vector import CMDPVectorEnv

if TYPE_CHECKING:
    from recrl.environments.safety_gym.batch import Booleans, Observations, Outcome, SafetyWorlds


class SafetyGymOptions(BaseModel):
    """Settings of all Safety Gym tasks."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    cost: Literal["indicator", "per_hazard"] = Field(
        default="indicator",
        description="One cost, 1 in a step in which any term costs (the paper's), or one cost per term.",
    )
    horizon: int = Field(
        default=HORIZON, ge=1, le=HORIZON, description="Steps in an episode (Safety Gym: 1,000)."
    )
    out_of_range: Literal["error", "clip"] = Field(
        default="error",
        description="Refuse actions outside [-1, 1], or clip them as Safety Gym does; agents clip theirs.",
    )
    num_threads: int = Field(
        default=1, ge=1, le=256, description="Threads for the physics (ours); results do not depend on it."
    )


def cost_names(task: SafetyTask, options: SafetyGymOptions) -> tuple[str, ...]:
    """The names of the k costs.

    Raises:
        ValueError: one cost per term is wanted of a task in which nothing costs.
    """
    if options.cost == "indicator":
        return ("cost",)
    if not task.cost_terms:
        raise ValueError(
            f"{task.name}: cost must be 'indicator', as nothing costs at level 0, got 'per_hazard'"
        )
    return task.cost_terms


def _make_worlds(task: SafetyTask, number: int, options: SafetyGymOptions) -> SafetyWorlds:
    """Worlds to be stepped; who only asks what there is to be set does not wait for MuJoCo and Numba."""
    from recrl.environments.safety_gym.batch import SafetyWorlds  # noqa: PLC0415

    return SafetyWorlds(task, number, horizon=options.horizon, num_threads=options.num_threads)


def _find(task: str) -> SafetyTask:
    if task not in SAFETY_TASKS:
        raise ValueError(f"task must be one of {', '.join(SAFETY_TASKS)}, got {task!r}")
    return SAFETY_TASKS[task]


def observation_components(task: SafetyTask) -> tuple[ObservationComponent, ...]:
    """The parts of a task's observation: the robot's sensors, and a lidar for each kind of object."""
    return tuple(
        ObservationComponent(name, size, LIDAR_RANGE if name.endswith("_lidar") else None)
        for name, size in task.components
    )


def _observation_space(task: SafetyTask) -> Box:
    return Box(-np.inf, np.inf, (task.observation_size,), np.float32)


def _action_space() -> Box:
    return Box(-1.0, 1.0, (2,), np.float32)


def _order(
    worlds: SafetyWorlds, actions: npt.NDArray[Any], shape: tuple[int, ...], options: SafetyGymOptions
) -> None:
    """Give the worlds their actions, or say in a sentence what is wrong with them."""
    out_of_range = options.out_of_range
    give_actions(worlds.task.name, worlds, actions, shape=shape, bound=1.0, out_of_range=out_of_range)


def _info(terms: tuple[str, ...], outcome: Outcome, options: SafetyGymOptions) -> dict[str, Any]:
    info: dict[str, Any] = {term: outcome.terms[row] for row, term in enumerate(terms)}
    info["cost"] = (outcome.terms if options.cost == "per_hazard" else outcome.costs).T
    info["goal_met"] = outcome.goal_met
    if outcome.broken is not None:
        info["cost_exception"] = outcome.broken.astype(np.float64)
    return info


def _renderer(worlds: SafetyWorlds) -> Renderer:
    from recrl.environments.safety_gym.rendering import SafetyRenderer  # noqa: PLC0415  # needs graphics

    return SafetyRenderer(worlds)


class SafetyGymVectorEnv(CMDPVectorEnv):
    """B environments of one Safety Gym task, stepped together.

    Args:
        task: for example ``CarGoal2``.
        num_envs: B, at least 1.
        render_mode: None or ``rgb_array``.
        options: the fields of ``SafetyGymOptions``.

    Attributes:
        worlds: what is stepped.
    """

    def __init__(self, task: str, num_envs: int = 1, render_mode: str | None = None, **options: Any) -> None:
        found = _find(task)
        if num_envs < 1:
            raise ValueError(f"{task}: num_envs must be at least 1, got {num_envs}")
        self.options = SafetyGymOptions(**options)
        self._terms = tuple(f"cost_{term}" for term in found.cost_terms)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self._camera = Camera(render_mode, _renderer)
        self.metadata = {
            **CMDPVectorEnv.metadata,
            "autoreset_mode": AutoresetMode.SAME_STEP,
            "render_modes": ["rgb_array"],
            "render_fps": frames_per_second(found),
        }
        self.single_observation_space = _observation_space(found)
        self.single_action_space = _action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.cmdp = CMDPSpec(
            task,
            self.single_observation_space,
            self.single_action_space,
            cost_names(found, self.options),
            self.options.horizon,
            observation_components(found),
        )
        self.worlds = _make_worlds(found, num_envs, self.options)

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
        if not worlds.generators:
            raise ValueError(f"{self.cmdp.name}: call reset before the first step")
        _order(worlds, actions, (self.num_envs, 2), self.options)
        outcome = worlds.advance()
        observations = worlds.observations()
        info = _info(self._terms, outcome, self.options)
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
        """Physics, sleeping bodies included, layouts, goals, counters and generators."""
        if not self.worlds.generators:
            raise ValueError(f"{self.cmdp.name}: there is no state before reset")
        return self.worlds.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken."""
        self.worlds.load_state_dict(state)


class SafetyGymEnv(gymnasium.Env[Any, Any]):
    """One environment of a Safety Gym task.

    Args:
        task: for example ``CarGoal2``.
        render_mode: None or ``rgb_array``.
        options: the fields of ``SafetyGymOptions``.

    Attributes:
        cost_names: names of the k costs in ``info["cost"]``, an array [k].
        observation_components: the parts of an observation, in their order.
        worlds: what is stepped: a single world.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012

    def __init__(self, task: str, render_mode: str | None = None, **options: Any) -> None:
        found = _find(task)
        self.options = SafetyGymOptions(**options)
        self._terms = tuple(f"cost_{term}" for term in found.cost_terms)
        self.render_mode = render_mode
        self._camera = Camera(render_mode, _renderer)
        self.metadata = {**self.metadata, "render_fps": frames_per_second(found)}
        self.cost_names = cost_names(found, self.options)
        self.observation_components = observation_components(found)
        self.observation_space = _observation_space(found)
        self.action_space = _action_space()
        self.worlds = _make_worlds(found, 1, self.options)

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
        worlds = self.worlds
        if not worlds.generators:
            raise ValueError(f"{worlds.task.name}: call reset before the first step")
        _order(worlds, action, (2,), self.options)
        outcome = worlds.advance()
        info = {name: values[0] for name, values in _info(self._terms, outcome, self.options).items()}
        return (
            worlds.observations()[0],
            float(outcome.rewards[0]),
            bool(outcome.terminated[0]),
            bool(outcome.truncated[0]),
            info,
        )

    def render(self) -> npt.NDArray[np.uint8]:
        """An RGB picture, [height, width, 3]."""
        return self._camera.frames(self.worlds)[0]

    def close(self) -> None:
        """Free what drawing needed."""
        self._camera.close()


def frames_per_second(task: SafetyTask) -> int:
    """Environment steps in a second of the task's time: 25 for the Car, 50 for the Point."""
    return round(1.0 / (task.timestep * SUBSTEPS))


def make_safety_gym(name: str, num_envs: int, options: SafetyGymOptions) -> SafetyGymVectorEnv:
    """B environments of a task by its name, for the registry of tasks."""
    return SafetyGymVectorEnv(name, num_envs, **options.model_dump())


def draw_safety_gym(name: str, options: SafetyGymOptions) -> SafetyGymEnv:
    """A task that draws itself, by its name, for the registry of tasks."""
    return SafetyGymEnv(name, render_mode="rgb_array", **options.model_dump())
