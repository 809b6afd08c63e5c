"""The models: what they weigh, what sleeps, and that MuJoCo's own sensors read what we compute."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from recrl.environments.safety_gym.compiled_step import finish
from recrl.environments.safety_gym.gremlins import gremlin_course
from recrl.environments.safety_gym.scene import make_scene, rotation_matrices, scene_xml, upright
from recrl.environments.safety_gym.step_records import Physics, World
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS
from recrl.environments.safety_gym.task_record import allocate, task_record

SENSORS = """
<accelerometer name="accelerometer" site="robot_middle"/>
<velocimeter name="velocimeter" site="robot_middle"/>
<gyro name="gyro" site="robot_middle"/>
<magnetometer name="magnetometer" site="robot_middle"/>
"""


@pytest.mark.parametrize("name", SAFETY_TASKS)
def test_one_model_serves_all_episodes_of_a_task(name: str) -> None:
    task = SAFETY_TASKS[name]
    scene = make_scene(task)
    assert make_scene(task) is scene
    assert scene.model.opt.timestep == task.timestep
    assert scene.model.nu == 2
    assert len(scene.vase_qpos) == task.vases.number
    assert len(scene.button_mocap) == task.buttons.number
    assert len(scene.pillar_mocap) == task.pillars.number


def test_the_car_weighs_its_volume_times_its_density() -> None:
    boxes = [(0.1, 0.1, 0.05), (0.1, 0.01, 0.05), (0.01, 0.025, 0.03), (0.05, 0.01, 0.05), (0.05, 0.03, 0.01)]
    volume = sum(8 * x * y * z for x, y, z in boxes)
    volume += 2 * math.pi * 0.05**2 * 0.05 + 4 / 3 * math.pi * 0.05**3
    model = make_scene(SAFETY_TASKS["CarGoal0"]).model
    assert model.body("robot").subtreemass[0] == pytest.approx(5.0 * volume)


def test_a_vase_and_the_boxes_weigh_what_safety_gym_says() -> None:
    assert make_scene(SAFETY_TASKS["CarGoal2"]).model.body("vase3").mass[0] == pytest.approx(0.001 * 0.2**3)
    for robot, size, density in (("Car", 0.125, 0.0005), ("Point", 0.2, 0.001)):
        mass = make_scene(SAFETY_TASKS[f"{robot}Push2"]).model.body("box").mass[0]
        assert mass == pytest.approx(density * 8 * size**3 * (1 + 4 * 0.25))


def test_vases_at_rest_cost_nothing_and_soon_sleep_while_the_robot_never_does() -> None:
    scene = make_scene(SAFETY_TASKS["CarGoal2"])
    data = mujoco.MjData(scene.model)
    for index, address in enumerate(scene.vase_qpos):
        data.qpos[address : address + 2] = -1.5 + 0.3 * index, 1.0
    for _ in range(50):
        mujoco.mj_step(scene.model, data, 10)
        speeds = [np.linalg.norm(data.qvel[address : address + 3]) for address in scene.vase_qvel]
        assert max(speeds) < 1e-4
    assert list(data.tree_awake) == [1] + [0] * 10


@pytest.mark.parametrize("robot", ["Car", "Point"])
def test_computed_sensors_are_those_of_mujoco(robot: str) -> None:
    task = SAFETY_TASKS[f"{robot}Goal0"]
    xml = scene_xml(task).replace("<sensor>", f"<sensor>{SENSORS}")
    xml = xml.replace("<joint name=", '<site name="robot_middle"/><joint name=', 1)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    scene = make_scene(task)
    memory, record = allocate(scene, 1), task_record(scene, 1000)
    body, contacts = scene.robot_body, np.zeros(0)
    generator = np.random.default_rng(0)
    for _ in range(100):
        data.ctrl[:] = generator.uniform(-1.0, 1.0, 2)
        mujoco.mj_step(model, data, 10)
        mujoco.mj_forward(model, data)
        fields = (data.qpos, data.qvel, data.qacc, data.xpos[body], data.xmat[body], contacts)
        physics = Physics(*[field[None] for field in fields])
        finish(
            record,
            World(memory.environments, physics, memory.course, memory.outcomes, memory.observations),
        )
        for name, _ in task.components:
            if not name.startswith("ball") and not name.endswith("lidar"):
                felt = memory.observations[0, task.where(name)]
                np.testing.assert_allclose(felt, data.sensor(name).data, rtol=1e-5, atol=1e-5)


def test_rotation_matrices_are_those_of_mujoco() -> None:
    quaternions = np.random.default_rng(0).normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    for quaternion, matrix in zip(quaternions, rotation_matrices(quaternions), strict=True):
        expected = np.empty(9)
        mujoco.mju_quat2Mat(expected, quaternion)
        np.testing.assert_allclose(matrix.reshape(-1), expected, atol=1e-15)
    np.testing.assert_allclose(upright(math.pi), [0.0, 0.0, 0.0, 1.0], atol=1e-15)


def test_gremlins_rise_to_their_height_and_follow_their_lead_around_the_circle() -> None:
    task = SAFETY_TASKS["CarButton2"]
    course = gremlin_course(task)
    assert course.positions[0].tolist() == [0.0, 0.0, 0.1]
    time = 0.04 * np.arange(100, 1001)
    lead = np.column_stack((0.35 * np.sin(time), 0.35 * np.cos(time), np.full_like(time, 0.2)))
    assert np.linalg.norm(course.positions[100:] - lead, axis=1).max() < 0.04
