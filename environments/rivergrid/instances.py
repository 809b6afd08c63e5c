"""Random RiverGrid instances with the properties of 1a or 1b, by rules independent of agents.

A river of varying width runs through the whole map, from north to south or from west to east. The start is on
one bank and the goal on the other. Either there is a safe path around the river, as on 1b, or there is none,
as on 1a.

One attempt draws, in this order:

- the direction of the river;
- its width and place in the first row, and row by row a change of each by -1, 0 or 1;
- with a safe path, the row in which the river has a dry ford;
- a wall on each inner tile with probability ``wall_share``;
- the bank of the start; the start, the goal and the heading.

Attempts are repeated until one is an instance (``is_instance``). Equal settings give equal maps on every
machine: all draws are floor(n u) of the raw 64-bit numbers u of PCG64, which NumPy guarantees not to change.
It does not guarantee this for its distributions.

Whether a map is an instance, and its limit d_d (``suggested_limit``), follow from the map alone, so nothing
can be tuned to an agent. Steps are a path's actions, turns included. Its cost is its time steps in the river.
"""

from __future__ import annotations

import functools
import heapq
from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from recrl.environments.options import Options
from recrl.environments.rivergrid.maps import (
    DRY,
    GOAL,
    RIVER,
    STARTS,
    STEPS,
    WALL,
    MapError,
    RiverMap,
    enclosed,
)

GENERATION_ATTEMPTS = 2_000
LEAST_DETOUR = 5  # steps that a safe path takes more than the shortest path; on 1b 11 against 6
LIMIT_PARTS = 5  # with a safe path, d_d allows one crossing in this number of episodes; on 1b 1 of 5

Tiles = list[list[str]]
Pose = tuple[int, int, int]  # x, y, heading


class InstanceSettings(Options):
    """Settings of a generated instance."""

    map_seed: int = Field(ge=0, description="Seed of the map; equal settings give equal maps (ours).")
    width: int = Field(default=9, ge=5, le=32, description="Columns, walls included (9 on 1a and 1b).")
    height: int = Field(default=9, ge=5, le=32, description="Rows, walls included (9 on 1a and 1b).")
    river_width: tuple[int, int] = Field(
        default=(2, 5),
        description="Least and largest width of the river in tiles (5 on 1a and 1b).",
    )
    wall_share: float = Field(
        default=0.1, ge=0.0, le=0.5, description="Probability that a tile is an inner wall (ours)."
    )
    safe_path: bool | None = Field(
        default=None,
        description="Whether a safe path around the river exists, as on 1b, or not, as on 1a; "
        "null draws it at random.",
    )

    @model_validator(mode="after")
    def _river_fits(self) -> Self:
        least, largest = self.river_width
        room = min(self.width, self.height) - 4  # two walls, two banks
        if not 1 <= least <= largest <= room:
            raise ValueError(
                f"river_width must be two widths from 1 to {room} in a map of {self.width} by {self.height}, "
                f"the least first, got {least} and {largest}"
            )
        return self


@dataclass(frozen=True)
class Route:
    """A path from the start to a goal.

    Attributes:
        steps: its actions, turns included.
        cost: the steps among them that end in the river.
    """

    steps: int
    cost: int


def quickest_route(river_map: RiverMap) -> Route | None:
    """Return the cheapest of the shortest paths, or None if there is no path."""
    length = _shortest(river_map, step=(1, 0), wet=(0, 1))
    return Route(steps=length[0], cost=length[1]) if length else None


def cheapest_route(river_map: RiverMap) -> Route | None:
    """Return the shortest of the cheapest paths, or None if there is no path."""
    length = _shortest(river_map, step=(0, 1), wet=(1, 0))
    return Route(steps=length[1], cost=length[0]) if length else None


def _shortest(river_map: RiverMap, *, step: tuple[int, int], wet: tuple[int, int]) -> tuple[int, int] | None:
    """Return the length of a shortest path to a goal (Dijkstra 1959), or None if there is none.

    Lengths are pairs in lexicographic order.

    Args:
        river_map: the map.
        step: what every step adds to a path's length.
        wet: what a step that ends in the river adds to it.
    """
    frontier: list[tuple[int, int, Pose]] = [(0, 0, (*river_map.start, river_map.heading))]
    done: set[Pose] = set()
    while frontier:
        first, second, pose = heapq.heappop(frontier)
        x, y, heading = pose
        if river_map.tile((x, y)) == GOAL:
            return first, second
        if pose in done:
            continue
        done.add(pose)
        ahead = (x + STEPS[heading][0], y + STEPS[heading][1], heading)
        for following in (ahead, (x, y, (heading + 1) % 4), (x, y, (heading - 1) % 4)):
            tile = river_map.tile(following[:2])
            if tile != WALL:
                in_river = int(tile == RIVER)
                length = (first + step[0] + in_river * wet[0], second + step[1] + in_river * wet[1])
                heapq.heappush(frontier, (*length, following))
    return None


def is_instance(river_map: RiverMap, settings: InstanceSettings, *, safe_path: bool) -> bool:
    """Whether a map has the properties of 1a or 1b.

    - The goal can be reached.
    - The shortest path leads through the river and costs at least the river's least width, so the
      unconstrained optimum enters the river.
    - With ``safe_path`` there is a safe path with at least ``LEAST_DETOUR`` more steps, so that it loses at
      least 0.5 of return. Without it no zero-cost path exists.

    The constraint binds at ``suggested_limit``. With a safe path, J*(d_d) < J*(inf). Without one, under no
    smaller limit every episode can reach the goal.
    """
    quickest, cheapest = quickest_route(river_map), cheapest_route(river_map)
    if quickest is None or cheapest is None or quickest.cost < settings.river_width[0]:
        return False
    if not safe_path:
        return cheapest.cost > 0
    return cheapest.cost == 0 and cheapest.steps >= quickest.steps + LEAST_DETOUR


def suggested_limit(river_map: RiverMap) -> float:
    """Return the limit d_d of a map, by a rule that gives 5 on 1a and 1 on 1b.

    Without a safe path it is the cost of the cheapest path, which then can be taken in every episode. With
    one it is a fifth of the cost of the shortest path, which the optimum then takes in at most one episode of
    five.

    Raises:
        MapError: the shortest path has no cost, so no limit makes a difference.
    """
    quickest, cheapest = quickest_route(river_map), cheapest_route(river_map)
    if quickest is None or cheapest is None or quickest.cost == 0:
        raise MapError("map: the shortest path does not cross the river, so no limit makes a difference")
    return float(cheapest.cost) if cheapest.cost else quickest.cost / LIMIT_PARTS


@functools.lru_cache
def draw_instance(settings: InstanceSettings) -> RiverMap:
    """Generate the map of the first attempt that is an instance.

    Raises:
        MapError: no instance was found in ``GENERATION_ATTEMPTS`` attempts.
    """
    draws = _Draws(settings.map_seed)
    safe_path = bool(draws.below(2)) if settings.safe_path is None else settings.safe_path
    for _ in range(GENERATION_ATTEMPTS):
        river_map = _attempt(draws, settings, safe_path)
        if river_map is not None and is_instance(river_map, settings, safe_path=safe_path):
            return river_map
    raise MapError(
        f"no instance in {GENERATION_ATTEMPTS} attempts met {InstanceSettings.model_dump_json(settings)}, "
        f"change the size, river_width, wall_share or safe_path"
    )


class _Draws:
    """Random integers from the raw numbers of PCG64, which are uniform on 0 to 2^64 - 1."""

    def __init__(self, seed: int) -> None:
        self._bits = np.random.PCG64(seed)

    def below(self, number: int) -> int:
        """Draw one of 0 to ``number`` - 1."""
        return int(self._bits.random_raw()) * number >> 64

    def happens(self, probability: float) -> bool:
        return int(self._bits.random_raw()) < probability * 2.0**64


def _attempt(draws: _Draws, settings: InstanceSettings, safe_path: bool) -> RiverMap | None:
    """Draw one map by the module's rules; None if a bank has no room for a start or a goal."""
    across, along = settings.width - 2, settings.height - 2
    eastward = draws.below(2) == 1
    if eastward:  # drawn as running south, then reflected
        across, along = along, across
    course = _course(draws, across, along, settings.river_width)
    ford = draws.below(along) if safe_path else None
    tiles = [
        [RIVER if first <= x < first + width and y != ford else DRY for x in range(across)]
        for y, (first, width) in enumerate(course)
    ]
    for row in tiles:
        row[:] = [WALL if draws.happens(settings.wall_share) else tile for tile in row]
    banks = [
        _dry(tiles, [range(first) for first, _ in course]),
        _dry(tiles, [range(first + width, across) for first, width in course]),
    ]
    if draws.below(2):
        banks.reverse()
    if not all(banks):
        return None
    (start_x, start_y), (goal_x, goal_y) = (bank[draws.below(len(bank))] for bank in banks)
    tiles[start_y][start_x] = STARTS[draws.below(len(STARTS))]
    tiles[goal_y][goal_x] = GOAL
    return enclosed("".join(row) for row in (zip(*tiles, strict=True) if eastward else tiles))


def _course(draws: _Draws, across: int, along: int, river_width: tuple[int, int]) -> list[tuple[int, int]]:
    """Draw the river's first tile and width in each row; at least one dry tile remains on either side."""
    least, largest = river_width
    width = least + draws.below(largest - least + 1)
    first = 1 + draws.below(across - 1 - width)
    course = [(first, width)]
    for _ in range(along - 1):
        width = min(max(width + draws.below(3) - 1, least), largest)
        first = min(max(first + draws.below(3) - 1, 1), across - 1 - width)
        course.append((first, width))
    return course


def _dry(tiles: Tiles, columns: list[range]) -> list[tuple[int, int]]:
    """Return the dry cells (x, y) among each row's columns, row by row."""
    return [(x, y) for y, row in enumerate(columns) for x in row if tiles[y][x] == DRY]
