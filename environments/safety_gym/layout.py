"""Where a Safety Gym episode begins: objects thrown down at random, none within another's keepout.

Objects are placed one after the other: robot, goal, box, buttons, hazards, vases, pillars, gremlins. Each
is drawn uniformly from the square, shrunk by its own keepout, until it is at least the sum of the two
keepouts away from all placed before; after 100 draws the whole layout is begun anew.

Source: openai/safety-gym ``engine.py``, ``sample_layout`` and ``sample_goal_position``.
"""

from __future__ import annotations

import numpy as np

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.tasks import ROBOT_KEEPOUT, SafetyTask
from recrl.environments.simulation.machine_code import compiled_for_arrays

TRIES = 100
"""Draws for one object before the whole layout is begun anew."""
LAYOUTS = 10_000
"""Layouts that are begun before giving up."""
GOAL_TRIES = 10_000
"""Draws for a new goal within an episode before the episode is ended."""

Layout = dict[str, Floats]
"""(x, y) of all objects of a kind, metres, [number, 2]; kinds without objects are there, with [0, 2]."""


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
    """Draw one layout.

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
    """Draw a new goal area that keeps away from where everything is now.

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
    """The first of the points drawn, [n, 2], whose squared distance to each other point is large enough.

    Where there is none: n.
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
