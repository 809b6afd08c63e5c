"""RiverGrid on MiniGrid, for Gymnasium; ``recrl.environments.rivergrid.grid_world`` defines the CMDP.

It is for rendering, wrapping and comparison. Training uses ``RiverGridVectorEnv``; a test compares the two
step by step.

Its names are ``recrl/RiverGrid-1a-v0``, ``recrl/RiverGrid-1b-v0`` and, with the keyword ``map`` for a map of
your own, ``recrl/RiverGrid-v0``. The other keywords are the task's options, too:

    gymnasium.make("recrl.environments.registration:recrl/RiverGrid-1a-v0", render_mode="rgb_array")
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box, Discrete
from minigrid.core.mission import MissionSpace
from minigrid.minigrid_env import MiniGridEnv

from recrl.environments.cmdp import Floats
from recrl.environments.rivergrid.grid_world import (
    FORWARD,
    GOAL_REWARD,
    STEP_REWARD,
    RiverGridOptions,
    river_observations,
    state_index,
    task_map,
    valid_options,
)
from recrl.environments.rivergrid.maps import MUD, RIVER
from recrl.environments.rivergrid.minigrid_drawing import TILE_PIXELS, river_minigrid


def mission() -> str:
    """Return MiniGrid's mission text; a named function, because MiniGrid pickles it."""
    return "reach the goal, mind the river"


class RiverGridEnv(MiniGridEnv):
    """One RiverGrid environment.

    Args:
        task: ``rivergrid-1a``, ``rivergrid-1b``, ``rivergrid`` or ``rivergrid-generated``.
        render_mode: None or one of MiniGrid's, such as ``rgb_array``.
        **options: of the task.

    Attributes:
        options: as given, with defaults.
        river_map: the map.
        cost_names: names of the k costs in ``info["cost"]``, an array [k].
        horizon: H, steps after which an episode is truncated.
    """

    def __init__(self, task: str = "rivergrid-1a", render_mode: str | None = None, **options: Any) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            known = ", ".join(map(repr, self.metadata["render_modes"]))
            raise ValueError(f"render_mode must be None, {known}, got {render_mode!r}")
        self.options = valid_options(task, options)
        self.river_map = task_map(task, self.options)
        self.cost_names = self.options.costs
        self.horizon = self.options.horizon
        self._task = task
        self._observations = river_observations(self.river_map, self.options.observation)
        super().__init__(
            mission_space=MissionSpace(mission_func=mission),
            width=self.river_map.width,
            height=self.river_map.height,
            max_steps=self.horizon,
            highlight=False,
            tile_size=TILE_PIXELS,
            render_mode=render_mode,
        )
        self.action_space = Discrete(3)
        self.observation_space = Box(0.0, 1.0, self._observations.shape[1:], np.float32)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one step; ``info["cost"]`` is float64 [k]."""
        if self.agent_dir is None:
            raise ValueError(f"{self._task}: call reset before the first step")
        if not self.action_space.contains(action):
            raise ValueError(f"{self._task}: the action must be 0, 1 or 2, got {action!r}")
        observation, _, terminated, truncated, _ = super().step(action)
        reward = GOAL_REWARD if terminated else STEP_REWARD
        return observation, reward, terminated, truncated and not terminated, {"cost": self._costs(action)}

    def render(self) -> Any:
        """Return the current frame, uint8 [height, width, 3]."""
        if self.agent_dir is None:
            raise ValueError(f"{self._task}: call reset before the first frame")
        return super().render()  # type: ignore[no-untyped-call]

    def gen_obs(self) -> npt.NDArray[np.float32]:
        """Return the current observation, a new array."""
        x, y = self.agent_pos
        seen: npt.NDArray[np.float32] = self._observations[
            state_index(self.river_map, int(x), int(y), int(self.agent_dir))
        ]
        return seen.copy()

    def _gen_grid(self, width: int, height: int) -> None:
        self.grid = river_minigrid(self.river_map)
        self.agent_pos, self.agent_dir = self.river_map.start, self.river_map.heading

    def _costs(self, action: int) -> Floats:
        tile = self.river_map.tile((int(self.agent_pos[0]), int(self.agent_pos[1])))
        costs = {"river": tile == RIVER, "turns": action != FORWARD, "mud": tile == MUD}
        return np.array([costs[name] for name in self.cost_names], np.float64)


def draw_river_grid(name: str, options: RiverGridOptions) -> RiverGridEnv:
    """Make a rendering RiverGrid environment, for the registry of tasks."""
    return RiverGridEnv(name, render_mode="rgb_array", **options.model_dump())
