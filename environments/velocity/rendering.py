"""Off-screen rendering of the velocity tasks: the robot, and a camera that follows it."""

from __future__ import annotations

import copy

import mujoco
import numpy as np

from recrl.environments.simulation.camera import Frame, make_context
from recrl.environments.velocity.batch import TORSO, VelocityBatch

MAX_GEOMS = 1000
CAMERA_ELEVATION, CAMERA_AZIMUTH = -20.0, 90.0


class VelocityRenderer:
    """Renderer for single robots of a task.

    Args:
        batch: the robots.
        width: of a frame, pixels.
        height: of a frame, pixels.

    Raises:
        RenderingUnavailableError: EGL and OSMesa are missing, or the library in MUJOCO_GL is.
    """

    def __init__(self, batch: VelocityBatch, width: int = 480, height: int = 360) -> None:
        self._batch = batch
        self._model = copy.copy(batch.model)
        self._model.vis.global_.offwidth, self._model.vis.global_.offheight = width, height
        self._model.vis.quality.offsamples = 0
        self._data = mujoco.MjData(self._model)
        self._context = make_context(width, height)
        self._drawing = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawing)
        self._scene = mujoco.MjvScene(self._model, maxgeom=MAX_GEOMS)
        # Without a graphics card these take nine tenths of the time of a frame.
        for effect in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[effect] = 0
        self._look = mujoco.MjvOption()
        self._area = mujoco.MjrRect(0, 0, width, height)
        self._camera = mujoco.MjvCamera()
        self._camera.distance = batch.task.camera_distance
        self._camera.elevation, self._camera.azimuth = CAMERA_ELEVATION, CAMERA_AZIMUTH

    def frame(self, index: int) -> Frame:
        """Render the present state of robot ``index``, [height, width, 3]."""
        row, state = self._batch.simulations.rows[index], mujoco.mjtState.mjSTATE_INTEGRATION.value
        mujoco.mj_setState(self._model, self._data, row, state)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._camera.lookat[:] = self._data.xpos[TORSO]
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, self._data, self._look, None, self._camera, everything, self._scene
        )
        picture = np.empty((self._area.height, self._area.width, 3), np.uint8)
        self._context.make_current()
        mujoco.mjr_render(self._area, self._scene, self._drawing)
        mujoco.mjr_readPixels(picture, None, self._area, self._drawing)
        return np.flipud(picture).copy()  # OpenGL counts rows from below

    def close(self) -> None:
        """Free the memory of the graphics driver."""
        self._drawing.free()
        self._context.free()
