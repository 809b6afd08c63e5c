"""A RiverGrid map as MiniGrid's objects, and its rendering."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import numpy.typing as npt
from minigrid.core.grid import Grid
from minigrid.core.world_object import Floor, Goal, Wall, WorldObj

from recrl.environments.rivergrid.maps import GOAL, MUD, RIVER, WALL, Cell, RiverMap

TILE_PIXELS = 32
OBJECTS: dict[str, Callable[[], WorldObj]] = {
    WALL: Wall,
    RIVER: Floor,  # a Floor is blue
    MUD: partial(Floor, "yellow"),
    GOAL: Goal,
}


def river_minigrid(river_map: RiverMap) -> Grid:
    """Return the map as MiniGrid's objects."""
    grid = Grid(river_map.width, river_map.height)
    for x in range(river_map.width):
        for y in range(river_map.height):
            kind = OBJECTS.get(river_map.tile((x, y)))
            grid.set(x, y, kind() if kind else None)
    return grid


def render_frame(river_map: RiverMap, cell: Cell, heading: int) -> npt.NDArray[np.uint8]:
    """Render the map with the agent in ``cell``, uint8 [height TILE_PIXELS, width TILE_PIXELS, 3]."""
    frame: npt.NDArray[np.uint8] = river_minigrid(river_map).render(TILE_PIXELS, cell, heading)
    return frame
