"""What Safety Gym's robots feel, computed from the physics' state instead of by MuJoCo's sensors.

All follow from the robot's coordinates: with R the rotation from the robot's frame to the world's, the
accelerometer reads R^T (a + (0, 0, 9.81)), the velocimeter R^T v, the magnetometer R^T (0, -0.5, 0) and the
gyro the angular velocity, which MuJoCo keeps in the robot's frame.

At the sizes of these arrays what costs time is the number of NumPy's calls. So the sensors of a robot are an
object that looks, once, where its numbers lie, and then writes them in a few calls.

The same product with R turns the places of the objects that the lidar sees into the robot's frame.

Letters: B environments, P objects.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.safety_tasks import ROBOT_HEIGHT, Robot

Places = npt.NDArray[np.intp]

GRAVITY = 9.81
MAGNETIC_FIELD = (0.0, -0.5, 0.0)
_UP = np.array((0.0, 0.0, GRAVITY))


def _rotation_form() -> Floats:
    """F [16, 9] such that the rotation matrix of a quaternion q is (q q^T) F, all flattened by rows."""
    w, x, y, z = range(4)
    entries = {
        0: ((w, w, 1), (x, x, 1), (y, y, -1), (z, z, -1)),
        1: ((x, y, 2), (w, z, -2)),
        2: ((x, z, 2), (w, y, 2)),
        3: ((x, y, 2), (w, z, 2)),
        4: ((w, w, 1), (x, x, -1), (y, y, 1), (z, z, -1)),
        5: ((y, z, 2), (w, x, -2)),
        6: ((x, z, 2), (w, y, -2)),
        7: ((y, z, 2), (w, x, 2)),
        8: ((w, w, 1), (x, x, -1), (y, y, -1), (z, z, 1)),
    }
    form = np.zeros((16, 9))
    for column, terms in entries.items():
        for row, other, sign in terms:
            form[4 * row + other, column] = sign
    return form


_ROTATION_FORM = _rotation_form()


def rotation_matrices(quaternions: Floats) -> Floats:
    """The rotation matrix of each unit quaternion (w, x, y, z): [..., 4] -> [..., 3, 3]."""
    products = quaternions[..., :, None] * quaternions[..., None, :]
    flat = products.reshape(*quaternions.shape[:-1], 16) @ _ROTATION_FORM
    matrices: Floats = flat.reshape(*quaternions.shape[:-1], 3, 3)
    return matrices


class RobotSensors(Protocol):
    """The sensors of B robots of one kind.

    Attributes:
        readings: everything that ``read`` finds, flat.
        places: for each sensor, by name, where in ``readings`` its numbers are, [B, size].
        rotation: R, from the robots' frames to the world's, [B, 3, 3].
        position: (the robots' positions) R, metres, [B, 3].
        points: (x, y) of objects on the floor, metres, to be written before ``read``, [B, P, 2].
        turned: (x, y, 0) R of them, [B, P, 3].
    """

    readings: Floats
    places: dict[str, Places]
    rotation: Floats
    position: Floats
    points: Floats
    turned: Floats

    def read(self) -> None:
        """Compute the readings from the state as it is now."""


class CarSensors:
    """The sensors of B Cars; see ``RobotSensors``.

    Args:
        qpos, qvel, qacc: live views of coordinates, velocities and accelerations, those of the robot first:
            [B, 13 or more], [B, 11 or more], [B, 11 or more].
        objects: P.
    """

    def __init__(self, qpos: Floats, qvel: Floats, qacc: Floats, objects: int) -> None:
        number = len(qpos)
        shapes = (4 + objects, 3), (2, 9), (2, 3)
        self.readings, (local, rotations, spins), places = _parts(number, *shapes)
        self.places = {
            "accelerometer": places[0][:, 0],
            "velocimeter": places[0][:, 1],
            "magnetometer": places[0][:, 2],
            "ballquat_rear": places[1][:, 1],
            "gyro": places[2][:, 0],
            "ballangvel_rear": places[2][:, 1],
        }
        # In the world's frame and in the robot's: acceleration, velocity, magnetic field, position, objects.
        self._world, self._local = np.zeros_like(local), local
        self._world[:, 2] = MAGNETIC_FIELD
        self._rows = [self._world[:, row] for row in range(4)]
        self._acceleration, self._velocity, self._position = qacc[:, :3], qvel[:, :3], qpos[:, :3]
        # Of the Car's body and of its rear ball: quaternions (from 3 and from 9), q q^T, rotations, and spins
        # (from 3 and from 8).
        quaternions = qpos[:, 1:13].reshape(number, 2, 6)[..., 2:]
        self._factors = quaternions[..., None], quaternions[..., None, :]
        self._products = np.zeros((number, 2, 4, 4))
        self._flat_products = self._products.reshape(number, 2, 16)
        self._rotations = rotations
        self._spins, self._felt_spins = qvel[:, 1:11].reshape(number, 2, 5)[..., 2:], spins
        self.rotation = rotations.reshape(number, 2, 3, 3)[:, 0]
        self.position = local[:, 3]
        self.points, self.turned = self._world[:, 4:, :2], local[:, 4:]

    def read(self) -> None:
        """Compute the readings from the state as it is now."""
        acceleration, velocity, _, position = self._rows
        np.add(self._acceleration, _UP, out=acceleration)
        velocity[...] = self._velocity
        position[...] = self._position
        np.multiply(*self._factors, out=self._products)
        np.matmul(self._flat_products, _ROTATION_FORM, out=self._rotations)
        np.matmul(self._world, self.rotation, out=self._local)
        self._felt_spins[...] = self._spins


class PointSensors:
    """The sensors of B Points; see ``RobotSensors``.

    Args:
        qpos, qvel, qacc: live views of coordinates, velocities and accelerations, (x, y, yaw) of the robot
            first: [B, 3 or more] each.
        objects: P.
    """

    def __init__(self, qpos: Floats, qvel: Floats, qacc: Floats, objects: int) -> None:
        number = len(qpos)
        self.readings, (local, spins), places = _parts(number, (4 + objects, 3), (3,))
        self.places = {
            "accelerometer": places[0][:, 0],
            "velocimeter": places[0][:, 1],
            "magnetometer": places[0][:, 2],
            "gyro": places[1],
        }
        self._world, self._local = np.zeros_like(local), local
        self._world[:, 0, 2] = GRAVITY
        self._world[:, 2] = MAGNETIC_FIELD
        self._world[:, 3, 2] = ROBOT_HEIGHT
        self._rows = [self._world[:, row, :2] for row in range(4)]
        self._acceleration, self._velocity, self._position = qacc[:, :2], qvel[:, :2], qpos[:, :2]
        self._yaw, self._spin, self._felt_spin = qpos[:, 2], qvel[:, 2], spins[:, 2]
        self.rotation = np.zeros((number, 3, 3))
        self.rotation[:, 2, 2] = 1.0
        self._cosines = self.rotation[:, 0, 0], self.rotation[:, 1, 1]
        self._sines = self.rotation[:, 1, 0], self.rotation[:, 0, 1]
        self.position = local[:, 3]
        self.points, self.turned = self._world[:, 4:, :2], local[:, 4:]

    def read(self) -> None:
        """Compute the readings from the state as it is now."""
        acceleration, velocity, _, position = self._rows
        acceleration[...] = self._acceleration
        velocity[...] = self._velocity
        position[...] = self._position
        self._cosines[1][...] = np.cos(self._yaw, out=self._cosines[0])
        np.negative(np.sin(self._yaw, out=self._sines[0]), out=self._sines[1])
        np.matmul(self._world, self.rotation, out=self._local)
        self._felt_spin[...] = self._spin


def make_sensors(robot: Robot, qpos: Floats, qvel: Floats, qacc: Floats, objects: int = 0) -> RobotSensors:
    """The sensors of B robots of one kind, whose numbers come first in these live views."""
    return _SENSORS[robot](qpos, qvel, qacc, objects)


_SENSORS: dict[str, type[CarSensors] | type[PointSensors]] = {"Car": CarSensors, "Point": PointSensors}


def _parts(number: int, *shapes: tuple[int, ...]) -> tuple[Floats, list[Floats], list[Places]]:
    """A flat array, views [B, *shape] of its parts, and where in it their numbers are."""
    ends = np.cumsum([number * math.prod(shape) for shape in shapes]).tolist()
    flat, places = np.zeros(ends[-1]), np.arange(ends[-1])
    starts = [0, *ends[:-1]]
    pieces = [
        (slice(start, end), (number, *shape)) for start, end, shape in zip(starts, ends, shapes, strict=True)
    ]
    return (
        flat,
        [flat[piece].reshape(shape) for piece, shape in pieces],
        [places[piece].reshape(shape) for piece, shape in pieces],
    )
