"""Safety Gym's pseudo-lidar: how close the nearest object of a kind is, in each direction around the robot.

The circle around the robot is divided into 16 sectors; sector b spans the angles 2 pi [b, b+1) / 16 from
the robot's x axis. An object at distance d reads max(0, 1 - d / 3) in its own sector, and fades into the
two next to it as it nears them ("aliasing"). Of several objects, each sector shows the one that reads most
there.

Letters: P objects, B environments, 16 sectors.

Source: openai/safety-gym ``engine.py``, ``obs_lidar_pseudo`` with ``lidar_num_bins`` 16, ``lidar_max_dist``
3 and ``lidar_alias``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.safety_tasks import LIDAR_BINS, LIDAR_RANGE

Reading = npt.NDArray[np.float32]

_HALF = LIDAR_BINS / 2
_CENTRES = ((np.arange(LIDAR_BINS) + 0.5 + _HALF) % LIDAR_BINS - _HALF).astype(np.float32)
_SECTORS_PER_RADIAN = np.float32(LIDAR_BINS / (2.0 * np.pi))


def egocentric(offsets: Floats, height: Floats, rotation: Floats) -> Reading:
    """Where objects on the floor lie in the robot's frame, as seen from above.

    ego = ((x, y, 0) - robot position) R, of which the first two numbers.

    Args:
        offsets: (x, y) of the objects minus those of the robot, metres, [2, P, B].
        height: of the robot, metres, [B].
        rotation: R, from the robot's frame to the world's, [B, 3, 3].

    Returns:
        metres, [2, P, B].
    """
    x, y = offsets
    ego = np.empty(offsets.shape, np.float32)
    for axis in (0, 1):
        ego[axis] = x * rotation[:, 0, axis] + y * rotation[:, 1, axis] - height * rotation[:, 2, axis]
    return ego


def closeness(ego: Reading) -> Reading:
    """What every single object would read: max(0, 1 - d / 3) clip(3/2 - t, 0, 1).

    t is the angle between the object and a sector's middle, in sectors: the weight is 1 within the object's
    own sector and falls to 0 across the next.

    Args:
        ego: objects in the robot's frame, [2, P, B].

    Returns:
        in [0, 1], [P, B, 16].
    """
    x, y = ego
    reach = np.maximum(np.float32(0.0), 1 - np.sqrt(x * x + y * y) * np.float32(1 / LIDAR_RANGE))
    sector = np.arctan2(y, x) * _SECTORS_PER_RADIAN
    weight = np.abs(sector[..., None] - _CENTRES)
    np.minimum(weight, LIDAR_BINS - weight, out=weight)
    np.subtract(np.float32(1.5), weight, out=weight)
    np.maximum(weight, np.float32(0.0), out=weight)
    np.minimum(weight, np.float32(1.0), out=weight)
    weighted: Reading = weight * reach[..., None]
    return weighted
