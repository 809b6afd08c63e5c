"""Off-screen rendering of the velocity tasks: the robot, and a camera that follows it."""

from __future__ import annotations

import copy

import mujoco

from recrl.environments.simulation.rendering import HEIGHT, WIDTH, MujocoRenderer
from recrl.environments.velocity.velocity_batch import TORSO, VelocityBatch

CAMERA_ELEVATION = -20.0


class VelocityRenderer(MujocoRenderer[VelocityBatch]):
    """Renderer for single robots of a task; see ``MujocoRenderer``."""

    def __init__(self, batch: VelocityBatch) -> None:
        model = copy.copy(batch.model)
        model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
        model.vis.quality.offsamples = 0
        distance = batch.task.camera_distance
        super().__init__(batch, model, distance=distance, elevation=CAMERA_ELEVATION)
        # Without a graphics card these take nine tenths of the time of a frame.
        for effect in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[effect] = 0

    def _aim_camera(self) -> None:
        self._camera.lookat[:] = self._data.xpos[TORSO]
