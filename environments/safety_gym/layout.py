"""Random initial layouts of Safety Gym: no object lies within another's keepout.

Objects are placed one after the other: robot, goal, box, buttons, hazards, vases, pillars, gremlins. Each is
drawn uniformly from the square, shrunk by its own keepout. The draw is repeated until the distance to all
placed objects is at least the sum of the keepouts. After 100 draws the layout starts anew.

Source: openai/safety-gym ``engine.py``, ``sample_layout`` and ``sample_goal_position``.
"""

from __future__ import annotations

import numpy as np

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.task_definitions import ROBOT_KEEPOUT, SafetyTask
from recrl.environments.simulation.machine_code import compiled_for_arrays

TRIES = 100
"""Draws for one object before the layout starts anew."""
LAYOUTS = 10_000
"""Layouts to try before an error."""
GOAL_TRIES = 10_000
"""Draws for a new goal within an episode before the episode ends."""

Layout = dict[str, Floats]
"""(x, y) of all objects by kind, metres, [number, 2]; kinds without objects have [0, 2]."""


def keepouts(task: SafetyTask) -> dict[str, tuple[int, float]]:
    """Number and keepout of each kind of object, in the order in which they are placed."""
    return {
        "robot": (1, ROBOT_KEEPOUT),
        "goal": (task.target.number, task.target.keepout),
        "box": (task.box.number, task.box.keepout),
        "buttons": (task.buttons.number, task.buttons.keepout),
        "hazards": (task.hazards.number, task.hazards.keepout),
        "vases": (task.vases.number, task.vases.keepout),
        "pillars": (task.pillars.number, task.pillars.keepout),
        "gremlins": (task.gremlins.number, task.gremlins.keepout),
    }


def sample_layout(task: SafetyTask, generator: np.random.Generator) -> Layout:
    """Sample one layout.

    Raises:
        RuntimeError: none was found in 10,000 attempts.
    """
    kinds = keepouts(task)
    radii = np.concatenate([np.full(number, keepout) for number, keepout in kinds.values()])
    for _ in range(LAYOUTS):
        places = _attempt(task.extent, radii, generator)
        if places is not None:
            ends = np.cumsum([number for number, _ in kinds.values()])
            return dict(zip(kinds, np.split(places, ends[:-1]), strict=True))
    raise RuntimeError(f"{task.name}: found no layout in {LAYOUTS} attempts")


def sample_goal(
    task: SafetyTask, others: Floats, other_keepouts: Floats, generator: np.random.Generator
) -> Floats | None:
    """Sample a new goal area away from all other objects.

    Args:
        task: gives the square and the goal's keepout.
        others: (x, y) of everything else, metres, [number, 2].
        other_keepouts: [number].
        generator: the episode's randomness.

    Returns:
        (x, y), [2], or None if there was no room.
    """
    bound = task.extent - task.target.keepout
    apart = np.square(other_keepouts + task.target.keepout)
    for _ in range(GOAL_TRIES // TRIES):
        drawn = generator.uniform(-bound, bound, (TRIES, 2))
        first = _first_free(drawn, others, apart)
        if first < TRIES:
            found: Floats = drawn[first]
            return found
    return None


def _attempt(extent: float, radii: Floats, generator: np.random.Generator) -> Floats | None:
    places = np.empty((len(radii), 2))
    for index, radius in enumerate(radii):
        bound = extent - radius
        drawn = generator.uniform(-bound, bound, (TRIES, 2))
        apart = np.square(radii[:index] + radius)
        first = _first_free(drawn, places[:index], apart)
        if first == TRIES:
            return None
        places[index] = drawn[first]
    return places


@compiled_for_arrays
def _first_free(drawn: Floats, others: Floats, apart: Floats) -> int:
    """Return the index of the first drawn point, [n, 2], that is far enough from each other point.

    It is n if there is none. Distances are compared as squares.
    """
    for place in range(len(drawn)):
        free = True
        for other in range(len(others)):
            x, y = drawn[place, 0] - others[other, 0], drawn[place, 1] - others[other, 1]
            if x * x + y * y < apart[other]:
                free = False
                break
        if free:
            return place
    return len(drawn)
