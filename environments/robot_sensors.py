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

GRAVITY = 9.81
MAGNETIC_FIELD = (0.0, -0.5, 0.0)


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
    """One robot's sensors and pose.

    Args:
        task: gives the robot and where each sensor goes in an observation.
    """

    def __init__(self, task: SafetyTask) -> None:
        self._car = task.robot == "Car"
        self._where = {name: task.where(name) for name, _ in task.components if "lidar" not in name}

    def pose(self, qpos: Floats) -> tuple[Floats, Floats]:
        """Position [B, 3] and rotation R [B, 3, 3] of the robot, from its coordinates [B, 13] or [B, 3]."""
        if self._car:
            return qpos[:, :3], rotation_matrices(qpos[:, 3:7])
        position = np.full((len(qpos), 3), ROBOT_HEIGHT)
        position[:, :2] = qpos[:, :2]
        cosine, sine = np.cos(qpos[:, 2]), np.sin(qpos[:, 2])
        rotation = np.zeros((len(qpos), 3, 3))
        rotation[:, 0, 0] = rotation[:, 1, 1] = cosine
        rotation[:, 0, 1], rotation[:, 1, 0] = -sine, sine
        rotation[:, 2, 2] = 1.0
        return position, rotation

    def read(
        self,
        qpos: Floats,
        qvel: Floats,
        qacc: Floats,
        rotation: Floats,
        out: npt.NDArray[np.float32],
    ) -> None:
        """Write all readings into observations.

        Args:
            qpos: the robot's coordinates, [B, ...].
            qvel: its velocities, [B, ...].
            qacc: its accelerations, [B, ...].
            rotation: R, [B, 3, 3].
            out: observations, [B, size].
        """
        number = len(qpos)
        world = np.zeros((number, 3, 3))  # acceleration, velocity, magnetic field
        moving = 3 if self._car else 2
        world[:, 0, :moving] = qacc[:, :moving]
        world[:, 0, 2] += GRAVITY
        world[:, 1, :moving] = qvel[:, :moving]
        world[:, 2] = MAGNETIC_FIELD
        local = world @ rotation
        where = self._where
        out[:, where["accelerometer"]] = local[:, 0]
        out[:, where["velocimeter"]] = local[:, 1]
        out[:, where["magnetometer"]] = local[:, 2]
        if self._car:
            out[:, where["gyro"]] = qvel[:, 3:6]
            out[:, where["ballangvel_rear"]] = qvel[:, 8:11]
            out[:, where["ballquat_rear"]] = rotation_matrices(qpos[:, 9:13]).reshape(number, 9)
        else:
            gyro = where["gyro"]
            out[:, gyro.start : gyro.stop - 1] = 0.0
            out[:, gyro.stop - 1] = qvel[:, 2]
