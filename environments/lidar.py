"""Safety Gym's pseudo-lidar: how close the nearest object of a kind is, in each direction around the robot.

The circle around the robot is divided into 16 sectors; sector b spans the angles 2 pi [b, b+1) / 16 from
the robot's x axis. An object at distance d reads max(0, 1 - d / 3) in its own sector, and fades into the
two next to it as it nears them ("aliasing"). Of several objects, each sector shows the one that reads most
there.

Letters: P objects, B environments, G kinds of objects, 16 sectors.

Source: openai/safety-gym ``engine.py``, ``obs_lidar_pseudo`` with ``lidar_num_bins`` 16, ``lidar_max_dist`` 3
and ``lidar_alias``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.safety_tasks import LIDAR_BINS, LIDAR_RANGE

Reading = npt.NDArray[np.float32]

_HALF = LIDAR_BINS / 2
_CENTRES = ((np.arange(LIDAR_BINS) + 0.5 + _HALF) % LIDAR_BINS - _HALF).astype(np.float32)
_SECTORS_PER_RADIAN = np.float32(LIDAR_BINS / (2.0 * np.pi))
_NEARNESS = np.float32(-1.0 / LIDAR_RANGE)
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_HALF_TURN, _FADE = np.float32(_HALF), np.float32(_HALF - 1.5)


def egocentric(turned: Floats, position: Floats) -> Reading:
    """Where objects on the floor lie in the robot's frame, as seen from above.

    With R the rotation from the robot's frame to the world's, ego = ((x, y, 0) - robot position) R, of which
    the first two numbers.

    Args:
        turned: (x, y, 0) R of the objects, metres, [B, P, 3].
        position: (robot position) R, metres, [B, 3].

    Returns:
        metres, [2, P, B].
    """
    ego = turned.transpose(2, 1, 0)[:2] - position.T[:2, None]
    return ego.astype(np.float32, order="C")


def lidar(ego: Reading, kinds: Sequence[slice], out: Reading) -> None:
    """Write the readings: for each kind of object the greatest max(0, 1 - d / 3) clip(3/2 - t, 0, 1).

    t is the angle between an object and a sector's middle, in sectors: the weight is 1 within the object's
    own sector and falls to 0 across the next. With a the plain difference of the two angles, at most a
    whole turn, the shorter way round is t = 8 - |8 - |a||.

    Args:
        ego: objects in the robot's frame, those of a kind together, [2, P, B].
        kinds: where in P each kind is, G of them.
        out: for the readings, in [0, 1], [G, B, 16].
    """
    x, y = ego
    reach = np.hypot(x, y)
    reach *= _NEARNESS
    reach += _ONE
    np.maximum(reach, _ZERO, out=reach)
    sector = np.arctan2(y, x)
    sector *= _SECTORS_PER_RADIAN
    weight = sector[..., None] - _CENTRES
    np.abs(weight, out=weight)
    weight -= _HALF_TURN
    np.abs(weight, out=weight)
    weight -= _FADE
    np.minimum(weight, _ONE, out=weight)
    weight *= reach[..., None]
    for kind, shown in zip(kinds, out, strict=True):
        np.maximum.reduce(weight[kind], axis=0, initial=_ZERO, out=shown)
