"""RiverGrid on MiniGrid, for Gymnasium; ``recrl.environments.rivergrid.grid_world`` defines the CMDP.

It is for rendering, wrapping and comparison. Training uses ``RiverGridVectorEnv``; a test compares the two
step by step.

Its names are ``recrl/RiverGrid-1a-v0``, ``recrl/RiverGrid-1b-v0`` and, with the keyword ``drawing`` for a map
of your own, ``recrl/RiverGrid-v0``:

    gymnasium.make("recrl.environments.registration:recrl/RiverGrid-1a-v0", render_mode="rgb_array")
"""

from __future__ import annotations

from collections.abc import Sequence
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
    HORIZON,
    STEP_REWARD,
    CostName,
    ObservationName,
    RiverGridOptions,
    river_observations,
    state_index,
    task_map,
)
from recrl.environments.rivergrid.maps import MAPS, MUD, RIVER, parse_map
from recrl.environments.rivergrid.minigrid_drawing import TILE_PIXELS, river_minigrid


def mission() -> str:
    """Return MiniGrid's mission text; a named function, because MiniGrid pickles it."""
    return "reach the goal, mind the river"


class RiverGridEnv(MiniGridEnv):
    """One RiverGrid environment.

    Args:
        drawing: the map, see ``recrl.environments.rivergrid.maps``.
        max_steps: H, steps after which an episode is truncated.
        costs: the cost functions, in order.
        observation: ``factored`` or ``joint``.
        **minigrid: MiniGrid's own, such as ``render_mode``.
    """

    def __init__(
        self,
        drawing: str = MAPS["1a"],
        *,
        max_steps: int = HORIZON,
        costs: Sequence[CostName] = ("river",),
        observation: ObservationName = "factored",
        **minigrid: Any,
    ) -> None:
        self.river_map = parse_map(drawing)
        self.cost_names = tuple(costs)
        self._observations = river_observations(self.river_map, observation)
        super().__init__(
            mission_space=MissionSpace(mission_func=mission),
            width=self.river_map.width,
            height=self.river_map.height,
            max_steps=max_steps,
            **{"highlight": False, "tile_size": TILE_PIXELS, **minigrid},
        )
        self.action_space = Discrete(3)
        self.observation_space = Box(0.0, 1.0, self._observations.shape[1:], np.float32)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one step; ``info["cost"]`` is float64 [k]."""
        if not self.action_space.contains(action):
            raise ValueError(f"RiverGrid: the action must be 0, 1 or 2, got {action!r}")
        observation, _, terminated, truncated, _ = super().step(action)
        reward = GOAL_REWARD if terminated else STEP_REWARD
        return observation, reward, terminated, truncated and not terminated, {"cost": self._costs(action)}

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
    return RiverGridEnv(
        str(task_map(name, options)),
        max_steps=options.horizon,
        costs=options.costs,
        observation=options.observation,
        render_mode="rgb_array",
    )
