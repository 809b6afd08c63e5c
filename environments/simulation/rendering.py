"""Off-screen rendering of MuJoCo tasks: the common part of all task families."""

from __future__ import annotations

import weakref
from typing import Any, Generic, TypeVar

import mujoco
import numpy as np

from recrl.environments.simulation.camera import Frame, make_context
from recrl.environments.simulation.environment_batch import EnvironmentBatch

WIDTH, HEIGHT = 480, 360  # of a frame, pixels
MAX_GEOMS = 1000
CAMERA_AZIMUTH = 90.0

BatchT = TypeVar("BatchT", bound=EnvironmentBatch[Any, Any])


class MujocoRenderer(Generic[BatchT]):
    """Renderer for single environments of a batch.

    Args:
        batch: the environments.
        model: the model to render, off-screen at least a frame wide and high; its state has the layout of
            the simulated one.
        distance: of the camera, metres.
        elevation: of the camera, degrees.

    Raises:
        RenderingUnavailableError: EGL and OSMesa are missing, or the library in MUJOCO_GL is.
    """

    def __init__(
        self,
        batch: BatchT,
        model: mujoco.MjModel,
        *,
        distance: float,
        elevation: float,
    ) -> None:
        self._batch = batch
        self._model = model
        self._data = mujoco.MjData(model)
        self._context = make_context(WIDTH, HEIGHT)
        self._drawing = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._drawing)
        self._scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._look = mujoco.MjvOption()
        self._area = mujoco.MjrRect(0, 0, WIDTH, HEIGHT)
        self._camera = mujoco.MjvCamera()
        self._camera.distance, self._camera.elevation, self._camera.azimuth = (
            distance,
            elevation,
            CAMERA_AZIMUTH,
        )
        self._free = weakref.finalize(self, _free, self._context, self._drawing)
        self._free.atexit = False  # the driver may be gone by then

    def frame(self, index: int) -> Frame:
        """Render the present state of environment ``index``, [height, width, 3]."""
        row, state = self._batch.simulations.rows[index], mujoco.mjtState.mjSTATE_INTEGRATION.value
        mujoco.mj_setState(self._model, self._data, row, state)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._aim_camera()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, self._data, self._look, None, self._camera, everything, self._scene
        )
        self._add_objects(index)
        picture = np.empty((self._area.height, self._area.width, 3), np.uint8)
        self._context.make_current()
        mujoco.mjr_render(self._area, self._scene, self._drawing)
        mujoco.mjr_readPixels(picture, None, self._area, self._drawing)
        return np.flipud(picture).copy()  # OpenGL counts rows from below

    def close(self) -> None:
        """Free the memory of the graphics driver; so does forgetting the renderer."""
        self._free()

    def _aim_camera(self) -> None:
        """Point the camera; by default at the origin."""

    def _add_objects(self, index: int) -> None:
        """Add what the model does not have to the scene of environment ``index``; by default nothing."""


def _free(context: Any, drawing: mujoco.MjrContext) -> None:
    """Free a drawing within its own context; a second context gives its objects the same numbers."""
    try:
        context.make_current()
    except Exception:  # at the end of the process the driver may be gone; each library fails in its own way
        return
    drawing.free()
    context.free()
