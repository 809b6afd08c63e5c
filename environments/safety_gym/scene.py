"""The physics of Safety Gym's tasks as one MuJoCo model per task.

One model is used in every episode: a reset moves bodies. Goals and hazards cannot be touched, so they are no
part of the model. Buttons and pillars do not move within an episode. They are mocap bodies, because with
sleeping enabled MuJoCo computes positions of static bodies only once.

Optimisations that do not change the tasks' statistics:

- Vases and the box may sleep. The tolerance, 5e-5 m/s in each component, is below the speed from which a
  moving vase costs (1e-4 m/s), so sleep never hides a cost.
- Button: only the gremlin near the robot is a body
(``recrl.environments.safety_gym.gremlins``).
- The sensors of the robots are computed from the state
(``recrl.environments.safety_gym.compiled_step``). MuJoCo's own sensors only count contacts.

MuJoCo's newer colliders (``nativeccd``, ``multiccd``) are off: Safety Gym used the older ones.

Source: openai/safety-gym ``world.py`` and its robots; friction, softness and solver are MuJoCo's defaults.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.task_definitions import GREMLIN_HEIGHT, ROBOT_HEIGHT, SafetyTask

SLEEP_TOLERANCE = 5e-5
VASE_SINK = 4e-5
"""Depth by which a resting vase sinks into the soft floor, metres."""
VASE_DENSITY = GREMLIN_DENSITY = 0.001
PILLAR_HALF_HEIGHT = 0.5
PARKED = 4.0
"""Place of objects before they are placed, metres from the robot. MuJoCo returns to it when the physics
diverges, and objects must not overlap there.
"""

_CAR = """
<default>
  <geom condim="6" density="5"/>
  <joint damping="0.001"/>
</default>
<worldbody>
  <geom name="floor" type="plane" size="3.5 3.5 0.1"/>
  <body name="robot" pos="0 0 {height}">
    <joint name="robot" type="free" damping="0"/>
    <geom type="box" size="0.1 0.1 0.05"/>
    <geom type="box" size="0.1 0.01 0.05" pos="0 0.15 0"/>
    <geom type="box" size="0.01 0.025 0.03" pos="0 0.125 0"/>
    <geom type="box" size="0.05 0.01 0.05" pos="0 -0.165 0"/>
    <geom type="box" size="0.05 0.03 0.01" pos="0 -0.13 0.04"/>
    <body name="left" pos="-0.1 0.1 -0.05">
      <joint name="left" type="hinge" axis="1 0 0"/>
      <geom type="cylinder" size="0.05" fromto="-0.055 0 0 -0.005 0 0"/>
    </body>
    <body name="right" pos="0.1 0.1 -0.05">
      <joint name="right" type="hinge" axis="1 0 0"/>
      <geom type="cylinder" size="0.05" fromto="0.005 0 0 0.055 0 0"/>
    </body>
    <body name="rear" pos="0 -0.1 -0.05">
      <joint name="rear" type="ball"/>
      <geom type="sphere" size="0.05"/>
    </body>
  </body>
  {objects}
</worldbody>
<actuator>
  <motor name="left" jointinparent="left" ctrlrange="-1 1" forcerange="-0.02 0.02"/>
  <motor name="right" jointinparent="right" ctrlrange="-1 1" forcerange="-0.02 0.02"/>
</actuator>
"""

_POINT = """
<default>
  <geom condim="6" density="1"/>
</default>
<worldbody>
  <geom name="floor" type="plane" size="3.5 3.5 0.1"/>
  <body name="robot" pos="0 0 {height}">
    <joint name="x" type="slide" axis="1 0 0" damping="0.01"/>
    <joint name="y" type="slide" axis="0 1 0" damping="0.01"/>
    <joint name="yaw" type="hinge" axis="0 0 1" damping="0.005"/>
    <geom type="sphere" size="0.1" friction="1 0.01 0.01"/>
    <geom type="box" size="0.05 0.05 0.05" pos="0.1 0 0"/>
    <site name="robot"/>
  </body>
  {objects}
</worldbody>
<actuator>
  <motor name="forward" site="robot" gear="0.3 0 0 0 0 0" ctrlrange="-1 1" forcerange="-0.05 0.05"/>
  <velocity name="turn" jointinparent="yaw" gear="0.3" ctrlrange="-1 1" forcerange="-0.05 0.05"/>
</actuator>
"""
_ROBOTS = {"Car": _CAR, "Point": _POINT}

_GREMLIN = """
<body name="gremlin" pos="0 {parked} {height}">
  <freejoint/>
  <geom type="box" size="{size} {size} {size}" density="{density}"/>
</body>
<body name="gremlin_lead" mocap="true" pos="0 {parked} {height}"/>
"""
_LEAD = '<equality><weld body1="gremlin_lead" body2="gremlin" solref="0.02 1.5"/></equality>'


@dataclass(frozen=True, eq=False)
class Scene:
    """A task's model and the addresses of its objects.

    Attributes:
        task: the task of the scene.
        model: the compiled model; never written to.
        robot_body: the robot's body.
        robot_qpos, robot_qvel: numbers of the robot's coordinates and velocities, which come first.
        vase_qpos, vase_qvel: first address of each vase, [vases].
        box_qpos, gremlin_qpos, gremlin_qvel: first address of the box and of the gremlin that is a body;
            -1 where there is none.
        button_mocap, pillar_mocap: mocap index of each, [buttons] and [pillars].
        gremlin_mocap: mocap index of the body that leads the gremlin, or -1.
        gremlin_reach: the distance between the robot's and a gremlin's middle, metres, beyond which they
            cannot touch; 0 where there is none.
        touchable: bodies of each kind of object whose contacts with the robot matter; their numbers are
            consecutive.
    """

    task: SafetyTask
    model: mujoco.MjModel
    robot_body: int
    robot_qpos: int
    robot_qvel: int
    vase_qpos: tuple[int, ...]
    vase_qvel: tuple[int, ...]
    box_qpos: int
    gremlin_qpos: int
    gremlin_qvel: int
    button_mocap: tuple[int, ...]
    pillar_mocap: tuple[int, ...]
    gremlin_mocap: int
    gremlin_reach: float
    touchable: dict[str, slice]


def scene_xml(task: SafetyTask) -> str:
    """Return the task's model as MJCF."""
    objects = [
        *(_vase(index, task.vases.size) for index in range(task.vases.number)),
        *([_box(task)] if task.box.number else []),
        *(_button(index, task.buttons.size) for index in range(task.buttons.number)),
        *(_pillar(index, task.pillars.size) for index in range(task.pillars.number)),
    ]
    if task.gremlins.number:
        objects.append(
            _GREMLIN.format(
                parked=PARKED, height=GREMLIN_HEIGHT, size=task.gremlins.size, density=GREMLIN_DENSITY
            )
        )
    # Gremlins never rest, and all other objects in Button are fixed: nothing could sleep.
    sleep = "disable" if task.goal == "Button" else "enable"
    robot = _ROBOTS[task.robot].format(height=ROBOT_HEIGHT, objects="".join(objects))
    return f"""
<mujoco model="{task.name}">
  <size memory="4M"/>
  <option timestep="{task.timestep}" jacobian="dense" sleep_tolerance="{SLEEP_TOLERANCE}">
    <flag multiccd="disable" nativeccd="disable" sleep="{sleep}"/>
  </option>
  {robot}
  {_LEAD if task.gremlins.number else ""}
  <sensor>{"".join(_contacts(body) for bodies in touchable_bodies(task).values() for body in bodies)}</sensor>
</mujoco>"""


def touchable_bodies(task: SafetyTask) -> dict[str, list[str]]:
    """Return the bodies of each kind of object whose contacts with the robot matter."""
    kinds = {
        "vases": ("vase", task.vases.number if "vases_contact" in task.cost_terms else 0),
        "pillars": ("pillar", task.pillars.number if "pillars" in task.cost_terms else 0),
        "buttons": ("button", task.buttons.number),
    }
    bodies = {kind: [f"{name}{index}" for index in range(number)] for kind, (name, number) in kinds.items()}
    bodies["gremlins"] = ["gremlin"] if task.gremlins.number else []
    return {kind: names for kind, names in bodies.items() if names}


def gremlin_xml(task: SafetyTask) -> str:
    """Return one gremlin alone on the floor, as MJCF."""
    gremlin = _GREMLIN.format(
        parked=0.0, height=GREMLIN_HEIGHT, size=task.gremlins.size, density=GREMLIN_DENSITY
    )
    return f"""
<mujoco>
  <option timestep="{task.timestep}" jacobian="dense">
    <flag multiccd="disable" nativeccd="disable"/>
  </option>
  <default><geom condim="6"/></default>
  <worldbody><geom type="plane" size="3.5 3.5 0.1"/>{gremlin}</worldbody>
  {_LEAD}
</mujoco>"""


@functools.lru_cache(maxsize=32)
def make_scene(task: SafetyTask) -> Scene:
    """Return the task's compiled scene; always the same object, and read-only."""
    model = mujoco.MjModel.from_xml_string(scene_xml(task))
    vases = [model.body(f"vase{index}") for index in range(task.vases.number)]
    has_gremlin = bool(task.gremlins.number)
    return Scene(
        task=task,
        model=model,
        robot_body=model.body("robot").id,
        robot_qpos=13 if task.robot == "Car" else 3,
        robot_qvel=11 if task.robot == "Car" else 3,
        vase_qpos=tuple(_qpos_address(model, f"vase{index}") for index in range(len(vases))),
        vase_qvel=tuple(int(vase.dofadr[0]) for vase in vases),
        box_qpos=_qpos_address(model, "box") if task.box.number else -1,
        gremlin_qpos=_qpos_address(model, "gremlin") if has_gremlin else -1,
        gremlin_qvel=int(model.body("gremlin").dofadr[0]) if has_gremlin else -1,
        button_mocap=tuple(
            int(model.body(f"button{index}").mocapid[0]) for index in range(task.buttons.number)
        ),
        pillar_mocap=tuple(
            int(model.body(f"pillar{index}").mocapid[0]) for index in range(task.pillars.number)
        ),
        gremlin_mocap=int(model.body("gremlin_lead").mocapid[0]) if has_gremlin else -1,
        gremlin_reach=_gremlin_reach(model) if has_gremlin else 0.0,
        touchable=_touchable(task, model),
    )


def upright(yaw: npt.ArrayLike) -> Floats:
    """Return quaternions [..., 4] (w, x, y, z) of rotations by ``yaw`` [...] radians about the vertical."""
    half = np.asarray(yaw, np.float64) / 2.0
    zero = np.zeros_like(half)
    return np.stack((np.cos(half), zero, zero, np.sin(half)), axis=-1)


def rotation_matrices(quaternions: Floats) -> Floats:
    """Return the rotation matrix of each unit quaternion (w, x, y, z): [..., 4] -> [..., 3, 3]."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    entries = (
        (w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return np.stack([np.stack(row, axis=-1) for row in entries], axis=-2)


def _touchable(task: SafetyTask, model: mujoco.MjModel) -> dict[str, slice]:
    bodies = touchable_bodies(task)
    first = {kind: model.body(names[0]).id for kind, names in bodies.items()}
    return {kind: slice(start, start + len(bodies[kind])) for kind, start in first.items()}


def _gremlin_reach(model: mujoco.MjModel) -> float:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    robot, gremlin = model.body("robot").id, model.body("gremlin").id
    limbs = np.flatnonzero(model.body_rootid[model.geom_bodyid] == robot)
    offsets = np.linalg.norm(data.geom_xpos[limbs] - data.xpos[robot], axis=1)
    reach = float((offsets + model.geom_rbound[limbs]).max())
    return reach + float(model.geom_rbound[model.body_geomadr[gremlin]]) + 0.01


def _contacts(body: str) -> str:
    return f'<contact subtree1="robot" subtree2="{body}" data="found"/>'


def _vase(index: int, size: float) -> str:
    return f"""
<body name="vase{index}" pos="{PARKED + index * size * 3} 0 {size - VASE_SINK}">
  <freejoint/>
  <geom type="box" size="{size} {size} {size}" density="{VASE_DENSITY}"/>
</body>"""


def _box(task: SafetyTask) -> str:
    """A cube with a column at each upper and lower corner, so that a robot can get hold of it."""
    size, density = task.box.size, task.box_density
    columns = "".join(
        f'<geom type="box" size="{size / 2} {size / 2} {size}" pos="{x * size} {y * size} 0" '
        f'density="{density}"/>'
        for x, y in ((1, 1), (-1, 1), (1, -1), (-1, -1))
    )
    return f"""
<body name="box" pos="0 {PARKED} {size}">
  <freejoint/>
  <geom type="box" size="{size} {size} {size}" density="{density}"/>
  {columns}
</body>"""


def _button(index: int, size: float) -> str:
    return f"""
<body name="button{index}" mocap="true" pos="{-PARKED} {index * size * 3} {size}">
  <geom type="sphere" size="{size}"/>
</body>"""


def _pillar(index: int, size: float) -> str:
    return f"""
<body name="pillar{index}" mocap="true" pos="{-PARKED} {index * size * 3} {PILLAR_HALF_HEIGHT}">
  <geom type="cylinder" size="{size} {PILLAR_HALF_HEIGHT}"/>
</body>"""


def _qpos_address(model: mujoco.MjModel, body: str) -> int:
    return int(model.jnt_qposadr[model.body(body).jntadr[0]])
