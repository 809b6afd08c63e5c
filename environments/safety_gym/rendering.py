"""Off-screen rendering of the Safety Gym tasks: robot, objects, goals, hazards and lidar.

Goals, hazards and the lidar's readings are no part of the physics' model; they are added to the frame. The
lidar is one ring of 16 spheres above the robot for each kind of object, brighter where something is near.

Source of colours and places of the spheres: openai/safety-gym ``engine.py``.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.gremlins import gremlin_course
from recrl.environments.safety_gym.safety_gym_batch import SafetyGymBatch
from recrl.environments.safety_gym.scene import rotation_matrices, scene_xml, upright
from recrl.environments.safety_gym.task_definitions import GOAL_HEIGHT, LIDAR_BINS
from recrl.environments.simulation.camera import Frame
from recrl.environments.simulation.rendering import MujocoRenderer

Colour = tuple[float, float, float]

COLOURS: dict[str, Colour] = {
    "robot": (0.8, 0.1, 0.15),
    "goal": (0.0, 1.0, 0.0),
    "box": (1.0, 1.0, 0.0),
    "buttons": (1.0, 0.5, 0.0),
    "hazards": (0.0, 0.0, 1.0),
    "vases": (0.0, 1.0, 1.0),
    "pillars": (0.5, 0.5, 1.0),
    "gremlins": (0.5, 0.0, 1.0),
}
SHADE = 0.25
"""Opacity of goals and hazards, which a robot can drive through."""
HAZARD_HEIGHT = 0.02
LIDAR_RADIUS, LIDAR_HEIGHT, LIDAR_RISE, LIDAR_SPHERE = 0.15, 0.5, 0.06, 0.025
FAINTEST = 0.1
CAMERA_DISTANCE, CAMERA_ELEVATION = 6.5, -50.0

# Without a graphics card, smoothed edges and finer spheres take four fifths of the time of a frame.
_ROOM = """
<visual>
  <headlight ambient="0.4 0.4 0.4" diffuse="0.5 0.5 0.5" specular="0 0 0"/>
  <global offwidth="1920" offheight="1080"/>
  <quality offsamples="0" numslices="20" numstacks="10"/>
</visual>
<asset>
  <texture type="skybox" builtin="gradient" rgb1="0.5 0.6 0.9" rgb2="0.1 0.1 0.4" width="64" height="64"/>
  <texture name="tiles" type="2d" builtin="checker" rgb1="0.7 0.7 0.7" rgb2="0.8 0.8 0.8"
           width="64" height="64"/>
  <material name="tiled" texture="tiles" texrepeat="10 10"/>
</asset>
"""


class SafetyRenderer(MujocoRenderer[SafetyGymBatch]):
    """Renderer for single environments of a batch; see ``MujocoRenderer``."""

    def __init__(self, batch: SafetyGymBatch) -> None:
        model = _coloured_model(batch)
        super().__init__(batch, model, distance=CAMERA_DISTANCE, elevation=CAMERA_ELEVATION)

    def frame(self, index: int) -> Frame:
        """Render the present state of environment ``index``, [height, width, 3]."""
        if self._batch.task.gremlins.number:
            geom = self._model.body("gremlin").geomadr[0]
            self._model.geom_rgba[geom, 3] = self._batch.embodied[index] >= 0  # else the body is none of them
        return super().frame(index)

    def _add_objects(self, index: int) -> None:
        self._add_areas(index)
        self._add_gremlins(index)
        self._add_lidar(index)

    def _add_areas(self, index: int) -> None:
        batch, task = self._batch, self._batch.task
        if task.target.number:
            size = task.target.size
            for place in batch.points[index, batch.group["goal"]]:
                self._add_cylinder((*place, GOAL_HEIGHT), size, size / 2, COLOURS["goal"])
        else:
            button = batch.points[index, batch.group["goal"].start]
            self._add_cylinder((*button, 0.01), 2 * task.buttons.size, 0.01, COLOURS["goal"])
        if "hazards" in batch.group:
            for place in batch.points[index, batch.group["hazards"]]:
                self._add_cylinder((*place, HAZARD_HEIGHT), task.hazards.size, 0.01, COLOURS["hazards"])

    def _add_gremlins(self, index: int) -> None:
        """Gremlins that are not simulated as a body at present."""
        batch, task = self._batch, self._batch.task
        if not task.gremlins.number:
            return
        heights = gremlin_course(task).positions[:, 2]
        height = float(heights[min(batch.steps[index], len(heights) - 1)])  # as gremlin_body.course_step
        for gremlin, place in enumerate(batch.points[index, batch.group["gremlins"]]):
            if gremlin != batch.embodied[index]:
                turn = rotation_matrices(upright(batch.gremlin_yaws[index, gremlin]))
                self._add(
                    mujoco.mjtGeom.mjGEOM_BOX,
                    np.full(3, task.gremlins.size),
                    np.array((*place, height)),
                    (*COLOURS["gremlins"], 1.0),
                    turn,
                )

    def _add_lidar(self, index: int) -> None:
        batch = self._batch
        observation = batch.observations()[index]
        body = self._data.body("robot")
        rotation = body.xmat.reshape(3, 3)
        angles = 2.0 * np.pi * (np.arange(LIDAR_BINS) + 0.5) / LIDAR_BINS
        for ring, kind in enumerate(batch.task.lidars):
            height = LIDAR_HEIGHT + LIDAR_RISE * ring
            for angle, reading in zip(angles, observation[batch.task.where(f"{kind}_lidar")], strict=True):
                place = (LIDAR_RADIUS * np.cos(angle), LIDAR_RADIUS * np.sin(angle), height)
                self._add(
                    mujoco.mjtGeom.mjGEOM_SPHERE,
                    np.full(3, LIDAR_SPHERE),
                    body.xpos + rotation @ place,
                    (*COLOURS[kind], min(1.0, float(reading) + FAINTEST)),
                )

    def _add_cylinder(
        self, place: tuple[float, ...], radius: float, half_height: float, colour: Colour
    ) -> None:
        size = np.array((radius, half_height, 0.0))
        self._add(mujoco.mjtGeom.mjGEOM_CYLINDER, size, np.array(place), (*colour, SHADE))

    def _add(
        self,
        shape: Any,
        size: Floats,
        place: Floats,
        rgba: tuple[float, ...],
        rotation: Floats | None = None,
    ) -> None:
        scene = self._scene
        turn = np.eye(3) if rotation is None else rotation
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom], shape, size, place, turn.reshape(9), np.array(rgba, np.float32)
        )
        scene.ngeom += 1


def _coloured_model(batch: SafetyGymBatch) -> mujoco.MjModel:
    """The task's model with colours and a visible floor; its state has the layout of the plain model."""
    xml = scene_xml(batch.task).replace("<option", f"{_ROOM}<option", 1)
    model = mujoco.MjModel.from_xml_string(xml.replace('name="floor"', 'name="floor" material="tiled"', 1))
    for geom in range(model.ngeom):
        body = model.body(model.body_rootid[model.geom_bodyid[geom]]).name
        for kind, colour in COLOURS.items():
            if body and body.startswith(kind.rstrip("s")):
                model.geom_rgba[geom] = (*colour, 1.0)
    return model
