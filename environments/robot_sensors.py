"""What Safety Gym's robots feel, computed from the physics' state instead of by MuJoCo's sensors.

All follow from the robot's coordinates: with R the rotation from the robot's frame to the world's, the
accelerometer reads R^T (a + (0, 0, 9.81)), the velocimeter R^T v, the magnetometer R^T (0, -0.5, 0) and the
gyro the angular velocity, which MuJoCo keeps in the robot's frame.

Letters: B environments.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.safety_tasks import ROBOT_HEIGHT, SafetyTask

Readings = npt.NDArray[np.float32]

GRAVITY = 9.81
MAGNETIC_FIELD = (0.0, -0.5, 0.0)
_UP = np.array((0.0, 0.0, GRAVITY))
_QUATERNIONS = np.array(((3, 4, 5, 6), (9, 10, 11, 12)))
"""Of the Car's body and of its rear ball, in its coordinates."""
_BALL_AND_ROBOT_SPINS = np.array((8, 9, 10, 3, 4, 5))


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


class RobotSensors:
    """The sensors of B robots of one kind.

    Args:
        task: gives the robot.
        number: B.

    Attributes:
        order: the sensors and their sizes, in the order in which ``read`` returns them.
    """

    def __init__(self, task: SafetyTask, number: int) -> None:
        self._car = task.robot == "Car"
        ball = (("ballquat_rear", 9), ("ballangvel_rear", 3)) if self._car else ()
        self.order = (("accelerometer", 3), ("velocimeter", 3), ("magnetometer", 3), *ball, ("gyro", 3))
        # In the world's frame: acceleration, velocity, magnetic field, position.
        self._world = np.zeros((number, 4, 3))
        self._world[:, 0, 2] = GRAVITY
        self._world[:, 2] = MAGNETIC_FIELD
        self._world[:, 3, 2] = ROBOT_HEIGHT
        self._local = np.zeros((number, 4, 3))
        self._flat_local = self._local.reshape(number, 12)
        # Of the Car's body and rear ball: q q^T, and the rotations that follow from it.
        self._products = np.zeros((number, 2, 4, 4))
        self._flat_products = self._products.reshape(number, 2, 16)
        self._rotations = np.zeros((number, 2, 9))
        self._rotation = self._rotations.reshape(number, 2, 3, 3)[:, 0]

    def read(self, qpos: Floats, qvel: Floats, qacc: Floats, out: Readings) -> tuple[Floats, Floats]:
        """Write what the robots feel, and find where they are.

        Args:
            qpos: the robots' coordinates, [B, 13] or [B, 3].
            qvel: their velocities, [B, 11] or [B, 3].
            qacc: their accelerations, [B, ...].
            out: for the readings, [B, size].

        Of the first three, numbers after the robots' own are ignored.

        Returns:
            rotations R from the robots' frames to the world's, [B, 3, 3], and (position) R, metres, [B, 3];
            both are overwritten by the next call.
        """
        if self._car:
            return self._read_car(qpos, qvel, qacc, out)
        world = self._world
        world[:, 0, :2] = qacc[:, :2]
        world[:, 1, :2] = qvel[:, :2]
        world[:, 3, :2] = qpos[:, :2]
        cosine, sine = np.cos(qpos[:, 2]), np.sin(qpos[:, 2])
        rotation = np.zeros((len(qpos), 3, 3))
        rotation[:, 0, 0] = rotation[:, 1, 1] = cosine
        rotation[:, 1, 0] = sine
        np.negative(sine, out=rotation[:, 0, 1])
        rotation[:, 2, 2] = 1.0
        np.matmul(world, rotation, out=self._local)
        out[:, :9] = self._flat_local[:, :9]
        out[:, 9:11] = 0.0
        out[:, 11] = qvel[:, 2]
        return rotation, self._local[:, 3]

    def _read_car(self, qpos: Floats, qvel: Floats, qacc: Floats, out: Readings) -> tuple[Floats, Floats]:
        world = self._world
        np.add(qacc[:, :3], _UP, out=world[:, 0])
        world[:, 1] = qvel[:, :3]
        world[:, 3] = qpos[:, :3]
        quaternions = qpos[:, _QUATERNIONS]
        np.multiply(quaternions[..., None], quaternions[..., None, :], out=self._products)
        np.matmul(self._flat_products, _ROTATION_FORM, out=self._rotations)
        np.matmul(world, self._rotation, out=self._local)
        out[:, :9] = self._flat_local[:, :9]
        out[:, 9:18] = self._rotations[:, 1]
        out[:, 18:] = qvel[:, _BALL_AND_ROBOT_SPINS]
        return self._rotation, self._local[:, 3]
