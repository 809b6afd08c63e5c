"""The pseudo-lidar against hand-computed readings and a literal transcription of its definition."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from recrl.environments.lidar import Reading, egocentric, lidar
from recrl.environments.robot_sensors import rotation_matrices
from recrl.environments.scene import upright


def reading(x: float, y: float) -> Reading:
    bins: Reading = readings(np.array([[[x]], [[y]]], np.float32), [slice(0, 1)])[0, 0]
    return bins


def readings(ego: Reading, kinds: list[slice]) -> Reading:
    out = np.full((len(kinds), ego.shape[2], 16), np.nan, np.float32)
    lidar(ego, kinds, out)
    return out


def literal_reading(x: float, y: float) -> npt.NDArray[np.float64]:
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
    assert reading(1.5 * math.cos(angle), 1.5 * math.sin(angle)) == pytest.approx(expected, abs=1e-6)


def test_an_object_between_two_sectors_shows_fully_in_both() -> None:
    expected = np.zeros(16)
    expected[[0, 15]] = 2.0 / 3.0
    assert reading(1.0, 0.0) == pytest.approx(expected, abs=1e-6)


def test_an_object_out_of_range_does_not_show() -> None:
    assert not reading(-3.0, 0.5).any()


def test_readings_are_those_of_the_literal_definition() -> None:
    generator = np.random.default_rng(0)
    for x, y in generator.uniform(-3.0, 3.0, (2000, 2)):
        np.testing.assert_allclose(reading(x, y), literal_reading(x, y), atol=2e-6)


def test_turning_the_robot_by_a_sector_turns_the_reading_by_a_sector() -> None:
    points, kinds = np.array([[[0.7, 0.4, 0.0], [-1.0, 0.2, 0.0]]]), [slice(0, 1), slice(1, 2)]
    still, turned = (
        readings(egocentric(points @ rotation_matrices(upright([yaw])), np.zeros((1, 3))), kinds)
        for yaw in (0.0, -math.pi / 8)
    )
    np.testing.assert_allclose(turned, np.roll(still, 1, axis=-1), atol=1e-6)


def test_a_tilted_robot_sees_the_floor_from_its_height() -> None:
    # Turned by 90 degrees about its x axis, it has the floor at distance 0.1 along its own y axis.
    rotation = rotation_matrices(np.array([[math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0]]))
    place = np.array([[0.0, 0.0, 0.1]]) @ rotation[0]
    ego = egocentric(np.array([[[1.0, 5.0, 0.0]]]) @ rotation, place)
    np.testing.assert_allclose(ego[:, 0, 0], [1.0, -0.1], atol=1e-6)


def test_of_several_objects_each_sector_shows_the_one_that_reads_most() -> None:
    objects = np.random.default_rng(1).uniform(-2.0, 2.0, (5, 2))
    together = readings(objects.T[..., None].astype(np.float32), [slice(0, 5)])[0, 0]
    np.testing.assert_array_equal(together, np.max([reading(x, y) for x, y in objects], axis=0))
