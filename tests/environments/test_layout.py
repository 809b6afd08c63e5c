"""Layouts keep their promises: inside the square, outside each other's keepouts, drawn from one generator."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from recrl.environments.safety_gym.layout import keepouts, sample_goal, sample_layout
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS

SLACK = 1e-12


@pytest.mark.parametrize("name", SAFETY_TASKS)
def test_nothing_lies_in_anothers_keepout_or_outside_the_square(name: str) -> None:
    task, generator = SAFETY_TASKS[name], np.random.default_rng(0)
    for _ in range(3):
        layout = sample_layout(task, generator)
        places = np.concatenate(list(layout.values()))
        radii = np.concatenate([np.full(number, keepout) for number, keepout in keepouts(task).values()])
        assert [len(layout[kind]) for kind in keepouts(task)] == [n for n, _ in keepouts(task).values()]
        assert (np.abs(places) <= task.extent - radii[:, None]).all()
        distances = np.linalg.norm(places[:, None] - places[None], axis=2)
        np.fill_diagonal(distances, np.inf)
        assert (distances >= radii[:, None] + radii[None] - SLACK).all()


def test_equal_generators_give_equal_layouts() -> None:
    task = SAFETY_TASKS["CarPush2"]
    one, other = (sample_layout(task, np.random.default_rng(5)) for _ in range(2))
    assert all(np.array_equal(one[kind], other[kind]) for kind in one)


def test_a_goal_keeps_away_from_everything() -> None:
    task, generator = SAFETY_TASKS["CarGoal2"], np.random.default_rng(0)
    others, radii = np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([0.4, 0.15])
    for _ in range(200):
        goal = sample_goal(task, others, radii, generator)
        assert goal is not None
        assert (np.linalg.norm(goal - others, axis=1) >= radii + 0.305 - SLACK).all()
        assert np.abs(goal).max() <= 2.0 - 0.305


def test_without_room_there_is_no_goal() -> None:
    task = SAFETY_TASKS["CarGoal0"]
    assert sample_goal(task, np.zeros((1, 2)), np.array([1.0]), np.random.default_rng(0)) is None


def test_an_impossible_layout_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recrl.environments.safety_gym.layout.LAYOUTS", 3)
    crowded = dataclasses.replace(SAFETY_TASKS["CarGoal2"], extent=0.7)
    with pytest.raises(RuntimeError, match="CarGoal2: found no layout in 3 attempts"):
        sample_layout(crowded, np.random.default_rng(0))
