"""Pictures of the tasks: right in size and content, harmless to the physics, or one clear sentence."""

from __future__ import annotations

import gc
import pickle
import sys

import numpy as np
import pytest

from recrl.environments.registry import make_vector
from recrl.environments.safety_gym.safety_gym_environments import SafetyGymEnv, SafetyGymVectorEnv
from recrl.environments.safety_gym.scene import PARKED
from recrl.environments.safety_gym.step_records import NO_GREMLIN, NOT_YET
from recrl.environments.safety_gym.task_definitions import GREMLIN_HEIGHT
from recrl.environments.simulation.camera import RenderingUnavailableError


def drawing(task: str) -> SafetyGymEnv:
    environment = SafetyGymEnv(task, render_mode="rgb_array")
    environment.reset(seed=1)
    try:
        environment.render()
    except RenderingUnavailableError as error:
        pytest.skip(str(error))
    return environment


@pytest.mark.parametrize("task", ["CarGoal2", "CarButton2", "PointPush2"])
def test_a_picture_is_rgb_and_changes_with_the_state(task: str) -> None:
    environment = drawing(task)
    first = environment.render()
    assert first.shape == (360, 480, 3)
    assert first.dtype == np.uint8
    assert np.array_equal(first, environment.render())
    for _ in range(20):
        environment.step(np.array([0.5, 0.7]))
    assert not np.array_equal(first, environment.render())
    environment.close()


def test_a_goal_and_the_lidar_are_seen_though_the_physics_has_neither() -> None:
    environment = drawing("CarGoal0")
    picture = environment.render().astype(int)
    greenish = (picture[..., 1] > picture[..., 0] + 40) & (picture[..., 1] > picture[..., 2] + 40)
    assert greenish.sum() > 200
    environment.batch.points[0, 0] = 50.0, 50.0  # far out of sight; the lidar's spheres fade
    elsewhere = environment.render().astype(int)
    green_now = (elsewhere[..., 1] > elsewhere[..., 0] + 40) & (elsewhere[..., 1] > elsewhere[..., 2] + 40)
    assert green_now.sum() < greenish.sum() / 4
    environment.close()


def test_gremlins_are_seen_after_the_end_of_an_episode() -> None:
    environment = drawing("PointButton1")
    environment.batch.steps[0] = 1000
    *_, truncated, _ = environment.step(np.zeros(2))
    assert truncated
    assert environment.batch.steps[0] == 1001
    purple = environment.render().astype(int)
    assert ((purple[..., 2] > purple[..., 1] + 60) & (purple[..., 2] > purple[..., 0] + 20)).sum() > 20
    environment.close()


@pytest.mark.parametrize(("embodied", "is_seen"), [(NOT_YET, False), (NO_GREMLIN, False), (0, True)])
def test_the_gremlins_body_is_seen_only_while_it_is_a_gremlin(embodied: int, is_seen: bool) -> None:
    environment = drawing("CarButton1")
    batch = environment.batch
    batch.embodied[0] = embodied
    place = slice(batch.scene.gremlin_qpos, batch.scene.gremlin_qpos + 3)
    assert batch.qpos[0, place].tolist() == [0.0, PARKED, GREMLIN_HEIGHT]  # in sight
    parked = environment.render()
    batch.qpos[0, place] = 0.0, 0.0, 20.0
    assert np.array_equal(parked, environment.render()) is not is_seen
    environment.close()


def test_drawing_changes_nothing() -> None:
    seen, unseen = drawing("CarGoal2"), SafetyGymEnv("CarGoal2")
    seen.reset(seed=3)
    unseen.reset(seed=3)
    for _ in range(30):
        action = np.array([0.9, 0.8])
        seen.render()
        assert np.array_equal(seen.step(action)[0], unseen.step(action)[0])
    pickle.dumps(seen)
    seen.close()


def test_a_batch_gives_a_picture_of_each_environment() -> None:
    drawing("CarGoal1").close()
    environment = SafetyGymVectorEnv("CarGoal1", 2, render_mode="rgb_array")
    environment.reset(seed=0)
    one, other = environment.render()
    assert not np.array_equal(one, other)
    environment.close()


@pytest.mark.parametrize("is_closed", [True, False])
def test_the_end_of_one_environment_leaves_the_pictures_of_another_alone(is_closed: bool) -> None:
    ended, other = drawing("CarGoal1"), drawing("CarGoal1")
    before = other.render()
    if is_closed:
        ended.close()
        ended.close()
    del ended
    gc.collect()
    assert np.array_equal(other.render(), before)
    other.close()


def test_without_a_graphics_library_there_is_one_clear_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    monkeypatch.setitem(sys.modules, "mujoco.osmesa", None)
    environment = SafetyGymEnv("CarGoal0", render_mode="rgb_array")
    environment.reset(seed=0)
    with pytest.raises(
        RenderingUnavailableError, match=r"drawing off-screen needs EGL .* or OSMesa .*; failed: "
    ):
        environment.render()


def test_rendering_must_be_asked_for() -> None:
    environment = SafetyGymEnv("CarGoal0")
    environment.reset(seed=0)
    with pytest.raises(
        ValueError, match="CarGoal0: to render, make the environment with render_mode='rgb_array'"
    ):
        environment.render()
    batch = make_vector("CarGoal0", 1)
    batch.reset(seed=0)
    with pytest.raises(ValueError) as caught:
        batch.render()
    assert str(caught.value) == (
        "CarGoal0: to render, make the environment with render_mode='rgb_array' in gymnasium.make or "
        "gymnasium.make_vec, or with recrl.make_env"
    )
    with pytest.raises(ValueError, match="render_mode must be None or 'rgb_array', got 'human'"):
        SafetyGymEnv("CarGoal0", render_mode="human")
