"""RiverGrid (paper, section 5 and figure 1): a grid world whose shortest path leads through a river.

Observation: one-hot x, one-hot y, one-hot heading (east, south, west, north), float32 [width + height + 4];
    with ``observation: joint`` one-hot (x, y, heading) as a whole, float32 [4 width height].
Action: Discrete(3), MiniGrid's first three: 0 turn left, 1 turn right, 2 forward (into a wall: stay).
Reward: -0.1 a step; +10 instead on the step that reaches a goal.
Cost: ``river`` is 1 for every time step that ends on a river tile, turning and bumping there included.
Optional are ``turns``, 1 for every turn, and ``mud``, 1 for every time step that ends on a mud tile. The
optimum is exact with two and three constraints, too.
Termination: at a goal; truncated after ``horizon`` steps (200).
Source: the paper's section 5 for the idea, the limits and the cost (time steps in the water). Maps, rewards
and horizon are ours, because the paper's text does not give them. All were chosen so that the paper's
statements can hold; not all of them do.

Deterministic: a seed changes nothing. ``RiverGridVectorEnv`` steps tables.
``recrl.environments.rivergrid.minigrid_env`` is the same CMDP on MiniGrid; a test compares them step by step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator, model_validator

from recrl.environments.cmdp import CostLimits
from recrl.environments.finite.finite_cmdp import FiniteCMDP, FiniteVectorEnv, InfeasibleLimitsError, Integers
from recrl.environments.options import Options
from recrl.environments.rivergrid.instances import InstanceSettings, draw_instance, quickest_route
from recrl.environments.rivergrid.maps import (
    GOAL,
    MAPS,
    MUD,
    RIVER,
    STEPS,
    WALL,
    RiverMap,
    parse_map,
    read_map,
)

STEP_REWARD = -0.1
GOAL_REWARD = 10.0
HORIZON = 200
HEADINGS = 4
LEFT, RIGHT, FORWARD = 0, 1, 2
CostName = Literal["river", "turns", "mud"]
ObservationName = Literal["factored", "joint"]


def require_reach(river_map: RiverMap, horizon: int, name: str) -> None:
    """Check that an agent can reach a goal of a map in ``horizon`` steps.

    Raises:
        ValueError: it cannot; the sentence has the smallest horizon.
    """
    quickest = quickest_route(river_map)
    if quickest is not None and horizon < quickest.steps:
        raise ValueError(
            f"horizon must be at least {quickest.steps}, the steps to the goal of {name}, got {horizon}"
        )


class RiverGridOptions(Options):
    """Options of ``rivergrid-1a`` and ``rivergrid-1b``, and common options of the other RiverGrid tasks."""

    horizon: int = Field(
        default=HORIZON, ge=1, le=10_000, description="H, steps after which an episode is truncated (ours)."
    )
    costs: tuple[CostName, ...] = Field(
        default=("river",),
        min_length=1,
        description="The cost functions in order, river (the paper's), turns and mud (ours), 1 a step each.",
    )
    observation: ObservationName = Field(
        default="factored",
        description="What agents observe. `factored`: x, y and heading, each one-hot, so that "
        "learning about a tile generalises to its row and column. `joint`: the joint "
        "state, one-hot, as in a table (ours).",
    )

    @field_validator("costs")
    @classmethod
    def _distinct(cls, costs: tuple[CostName, ...]) -> tuple[CostName, ...]:
        if len(set(costs)) != len(costs):
            raise ValueError(f"must differ, got {', '.join(costs)}")
        return costs


class RiverGridMapOptions(RiverGridOptions):
    """Options of ``rivergrid``: a map of your own."""

    map: str = Field(
        description="The map as text, or the path of a text file with it; the map itself is stored."
    )

    @field_validator("map")
    @classmethod
    def _drawn(cls, text: str) -> str:
        # A trial depends on the map and not on its path, so the options store the map.
        return str(parse_map(text) if "\n" in text else read_map(Path(text)))

    def river_map(self) -> RiverMap:
        """The map of these settings."""
        return parse_map(self.map)

    @model_validator(mode="after")
    def _goal_is_in_reach(self) -> Self:
        require_reach(self.river_map(), self.horizon, "the map")
        return self


class RiverGridGeneratedOptions(RiverGridOptions, InstanceSettings):
    """Options of ``rivergrid-generated``: a random instance with the properties of 1a or 1b."""

    @model_validator(mode="after")
    def _goal_is_in_reach(self) -> Self:
        require_reach(self.river_map(), self.horizon, f"map {self.map_seed}")
        return self

    def river_map(self) -> RiverMap:
        """The map of these settings."""
        return draw_instance(self)


TASK_OPTIONS: dict[str, type[RiverGridOptions]] = {
    "rivergrid-1a": RiverGridOptions,
    "rivergrid-1b": RiverGridOptions,
    "rivergrid": RiverGridMapOptions,
    "rivergrid-generated": RiverGridGeneratedOptions,
}


def valid_options(task: str, options: Mapping[str, Any]) -> RiverGridOptions:
    """Return the validated options of a RiverGrid task with defaults.

    Raises:
        ValueError: there is no such task, or an option is wrong.
    """
    if task not in TASK_OPTIONS:
        raise ValueError(f"task must be one of {', '.join(TASK_OPTIONS)}, got {task!r}")
    return TASK_OPTIONS[task].model_validate(dict(options))


def state_index(river_map: RiverMap, x: int, y: int, heading: int) -> int:
    """Index of the state (x, y, heading): (x * height + y) * 4 + heading."""
    return (x * river_map.height + y) * HEADINGS + heading


def river_observations(river_map: RiverMap, observation: ObservationName) -> npt.NDArray[np.float32]:
    """Return the observation of each state, float32 [S, width + height + 4], or [S, S] with ``joint``."""
    shape = (river_map.width, river_map.height, HEADINGS)
    if observation == "joint":
        return np.eye(math.prod(shape), dtype=np.float32)
    columns = np.indices(shape).reshape(3, -1)
    return np.concatenate(
        [np.eye(size, dtype=np.float32)[index] for size, index in zip(shape, columns, strict=True)], axis=1
    )


def river_cmdp(river_map: RiverMap, *, costs: Sequence[CostName], horizon: int) -> FiniteCMDP:
    """Return the tables of RiverGrid: S = 4 width height states, unreachable ones (walls) included."""
    num_states = river_map.width * river_map.height * HEADINGS
    successors: Integers = np.zeros((num_states, 3), np.int64)
    tiles = np.full(num_states, WALL)
    for x in range(river_map.width):
        for y in range(river_map.height):
            tile = river_map.tile((x, y))
            for heading in range(HEADINGS):
                state = state_index(river_map, x, y, heading)
                tiles[state] = tile
                successors[state, LEFT] = state_index(river_map, x, y, (heading - 1) % HEADINGS)
                successors[state, RIGHT] = state_index(river_map, x, y, (heading + 1) % HEADINGS)
                successors[state, FORWARD] = state
                ahead = (x + STEPS[heading][0], y + STEPS[heading][1])
                if tile != WALL and river_map.tile(ahead) != WALL:
                    successors[state, FORWARD] = state_index(river_map, *ahead, heading)
    reached, terminal = tiles[successors], tiles == GOAL
    cost_tables = {
        "river": (reached == RIVER).astype(np.float64),
        "turns": np.tile([1.0, 1.0, 0.0], (num_states, 1)),
        "mud": (reached == MUD).astype(np.float64),
    }
    start = np.zeros(num_states)
    start[state_index(river_map, *river_map.start, river_map.heading)] = 1.0
    return FiniteCMDP(
        successors=successors[:, :, None],
        probabilities=np.ones((num_states, 3, 1)),
        rewards=np.where(terminal[successors], GOAL_REWARD, STEP_REWARD),
        costs=np.stack([cost_tables[name] for name in costs], axis=2),
        terminal=terminal,
        start=start,
        horizon=horizon,
        cost_names=tuple(costs),
    )


class RiverGridVectorEnv(FiniteVectorEnv):
    """B RiverGrids stepped by table look-ups; see the module's docstring.

    Attributes:
        river_map: the map.
    """

    render_mode: str | None = "rgb_array"
    metadata: dict[str, Any] = {  # noqa: RUF012
        **FiniteVectorEnv.metadata,
        "render_modes": ["rgb_array"],
        "render_fps": 10,
    }

    def __init__(self, name: str, river_map: RiverMap, options: RiverGridOptions, *, num_envs: int) -> None:
        model = river_cmdp(river_map, costs=options.costs, horizon=options.horizon)
        observations = river_observations(river_map, options.observation)
        super().__init__(name, model, observations, num_envs=num_envs)
        self.river_map = river_map

    def render(self) -> tuple[npt.NDArray[np.uint8], ...] | None:
        """Render one RGB frame per environment, uint8 [height * 32, width * 32, 3], with MiniGrid.

        Returns:
            The frames; None if ``render_mode`` is None.
        """
        if self.render_mode is None:
            return None
        if not self.has_begun:
            raise ValueError(f"{self.cmdp.name}: call reset before the first frame")
        # MiniGrid takes long to import
        from recrl.environments.rivergrid.minigrid_drawing import render_frame  # noqa: PLC0415

        frames = []
        for state in self.states.tolist():
            cell, heading = divmod(state, HEADINGS)
            frames.append(render_frame(self.river_map, divmod(cell, self.river_map.height), heading))
        return tuple(frames)


def task_map(name: str, options: RiverGridOptions) -> RiverMap:
    """Return the map of a task: 1a, 1b, or that of the options.

    Raises:
        ValueError: no agent can reach its goal within the horizon.
    """
    if isinstance(options, RiverGridMapOptions | RiverGridGeneratedOptions):
        return options.river_map()
    river_map = parse_map(MAPS[name.removeprefix("rivergrid-")])
    require_reach(river_map, options.horizon, name)
    return river_map


def make_river_grid(name: str, num_envs: int, options: RiverGridOptions) -> RiverGridVectorEnv:
    """Make B environments of a RiverGrid task."""
    return RiverGridVectorEnv(name, task_map(name, options), options, num_envs=num_envs)


def vector_of_task(
    task: str, num_envs: int = 1, render_mode: str | None = None, **options: Any
) -> RiverGridVectorEnv:
    """Make B environments of a RiverGrid task, for ``gymnasium.make_vec``.

    Args:
        task: a key of ``TASK_OPTIONS``.
        num_envs: B, at least 1.
        render_mode: None or ``rgb_array``.
        **options: of the task.
    """
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
    environment = make_river_grid(task, num_envs, valid_options(task, options))
    environment.render_mode = render_mode
    return environment


def river_grid_optimum(name: str, options: RiverGridOptions, limits: CostLimits) -> float:
    """Return J*(d), exact to about 1e-9; -inf if no policy keeps the limits."""
    # SciPy takes half a second to import, and trials do not use it.
    from recrl.environments.finite.exact_solver import solve_by_lagrangian  # noqa: PLC0415

    limits.require_one_per_cost(len(options.costs), name)
    model = river_cmdp(task_map(name, options), costs=options.costs, horizon=options.horizon)
    try:
        return float(solve_by_lagrangian(model, limits).episode_return)
    except InfeasibleLimitsError:
        return -math.inf
