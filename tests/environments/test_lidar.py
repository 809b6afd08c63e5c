"""The pseudo-lidar against hand-computed readings and a literal transcription of its definition."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from recrl.environments.cmdp import Floats
from recrl.environments.safety_gym.lidar import add_to_lidar
from recrl.environments.safety_gym.safety_gym_environments import SafetyGymVectorEnv
from recrl.environments.safety_gym.scene import rotation_matrices, upright
from recrl.environments.safety_gym.step_records import turned


def reading(*places: tuple[float, float]) -> npt.NDArray[np.float32]:
    """What 16 bins read of objects in the robot's frame."""
    bins = np.zeros(16, np.float32)
    for x, y in places:
        add_to_lidar(float(x), float(y), 3.0, bins)
    return bins


def literal_reading(x: float, y: float) -> Floats:
    """Safety Gym's definition, number by number."""
    bins = np.zeros(16)
    sector = (math.atan2(y, x) % (2 * math.pi)) / (2 * math.pi / 16)
    own, alias = int(sector), sector - int(sector)
    sensor = max(0.0, 3.0 - math.hypot(x, y)) / 3.0
    bins[own] = sensor
    bins[(own + 1) % 16] = max(bins[(own + 1) % 16], alias * sensor)
    bins[(own - 1) % 16] = max(bins[(own - 1) % 16], (1 - alias) * sensor)
    return bins


def test_an_object_in_the_middle_of_a_sector_half_shows_in_the_two_next_to_it() -> None:
    angle = math.pi / 16
    expected = np.zeros(16)
    expected[[0, 1, 15]] = 0.5, 0.25, 0.25
    assert reading((1.5 * math.cos(angle), 1.5 * math.sin(angle))) == pytest.approx(expected, abs=1e-6)


def test_an_object_between_two_sectors_shows_fully_in_both() -> None:
    expected = np.zeros(16)
    expected[[0, 15]] = 2.0 / 3.0
    assert reading((1.0, 0.0)) == pytest.approx(expected, abs=1e-6)
    assert reading((1.0, -1e-300)) == pytest.approx(expected, abs=1e-6)


def test_an_object_out_of_range_does_not_show() -> None:
    assert not reading((-3.0, 0.5)).any()


def test_readings_are_those_of_the_literal_definition() -> None:
    for x, y in np.random.default_rng(0).uniform(-3.0, 3.0, (2000, 2)):
        np.testing.assert_allclose(reading((x, y)), literal_reading(x, y), atol=2e-6)


def test_turning_the_robot_by_a_sector_turns_the_reading_by_a_sector() -> None:
    still, frames = reading((0.7, 0.4), (-1.0, 0.2)), []
    rotation = rotation_matrices(upright(-math.pi / 8)).reshape(9)
    for x, y in ((0.7, 0.4), (-1.0, 0.2)):
        frames.append(turned(rotation, x, y, 0.0)[:2])
    np.testing.assert_allclose(reading(*frames), np.roll(still, 1), atol=1e-6)


def test_a_tilted_robot_sees_the_floor_from_its_height() -> None:
    # Turned by 90 degrees about its x axis, it has the floor at distance 0.1 along its own y axis.
    rotation = rotation_matrices(np.array([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0])).reshape(9)
    np.testing.assert_allclose(turned(rotation, 1.0, 5.0, -0.1)[:2], [1.0, -0.1], atol=1e-6)


def test_of_several_objects_each_sector_shows_the_one_that_reads_most() -> None:
    places = [(x, y) for x, y in np.random.default_rng(1).uniform(-2.0, 2.0, (5, 2))]
    np.testing.assert_array_equal(reading(*places), np.max([reading(place) for place in places], axis=0))


@pytest.mark.parametrize("name", ["CarGoal2", "CarButton2", "CarPush2"])
def test_a_robot_sees_every_kind_of_object_where_it_is(name: str) -> None:
    environment = SafetyGymVectorEnv(name, 2)
    environment.reset(seed=3)
    batch, task = environment.batch, environment.batch.task
    for action in np.random.default_rng(0).uniform(-1.0, 1.0, (30, 2, 2)):
        seen = environment.step(action)[0]
        for index, robot in enumerate(batch.qpos[:, :7]):
            offsets = np.zeros((batch.points.shape[1], 3)) - robot[:3]
            offsets[:, :2] += batch.points[index]
            places = offsets @ rotation_matrices(robot[3:])
            for kind, group in batch.group.items():
                expected = np.max([literal_reading(x, y) for x, y, _ in places[group]], axis=0)
                np.testing.assert_allclose(seen[index, task.where(f"{kind}_lidar")], expected, atol=2e-6)
