"""The pseudo-lidar of the Safety Gym robots: readings in [0, 1] in sectors around the robot.

Each kind of object has its own lidar. A reading is 1 at the robot, and 0 from ``lidar_range`` metres on.

Source: openai/safety-gym ``engine.py``.
"""

from __future__ import annotations

import math
from typing import Any

from recrl.environments.safety_gym.step_records import BUTTONS, turned
from recrl.environments.simulation.machine_code import compiled


@compiled
def add_to_lidar(x: float, y: float, lidar_range: float, bins: Any) -> None:
    """Add one object to the pseudo-lidar: each bin holds the maximum over objects.

    The circle around the robot is divided into sectors. An object at distance d reads r = max(0, 1 - d /
    range) in its own sector. With u in [0, 1) its relative angle there, it reads u r in the next
    sector and (1 - u) r in the one before ("aliasing").

    Args:
        x: the object's place in the robot's frame, metres.
        y: likewise.
        lidar_range: metres.
        bins: readings so far, [sectors].
    """
    reading = 1.0 - math.hypot(x, y) / lidar_range
    if not reading > 0.0:
        return
    sectors = len(bins)
    sector = math.atan2(y, x) * (sectors / (2.0 * math.pi))
    if sector < 0.0:
        sector += sectors
    own = int(sector)
    through = sector - own
    own %= sectors
    after, before = (own + 1) % sectors, (own - 1) % sectors
    bins[own] = max(bins[own], reading)
    bins[after] = max(bins[after], through * reading)
    bins[before] = max(bins[before], (1.0 - through) * reading)


@compiled
def write_lidar(task: Any, environment: Any, data: Any, seen: Any) -> None:
    """Write the readings of all lidars, one for each kind of object, into an observation.

    Args:
        task: a record ``TASK``.
        environment: a record ``ENVIRONMENT``.
        data: its ``Physics``.
        seen: the observation, [observed]; buttons are not seen while they are inactive.
    """
    size = task.lidar_bins
    rotation, robot = data.rotation, data.place
    for kind in range(len(task.lidar)):
        if task.lidar[kind] < 0:
            continue
        bins = seen[task.lidar[kind] : task.lidar[kind] + size]
        for sector in range(size):
            bins[sector] = 0.0
        if kind == BUTTONS and environment.button_timer > 0:
            continue
        for place in range(task.start[kind], task.stop[kind]):
            point = environment.points[place]
            x, y, _ = turned(rotation, point[0] - robot[0], point[1] - robot[1], -robot[2])
            add_to_lidar(x, y, task.lidar_range, bins)
