"""Our environments, put into recorded states, observe, earn, pay and move as was recorded."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from recrl.environments.safety_gym import scene
from recrl.environments.safety_gym.task_definitions import SAFETY_TASKS
from tests.benchmarks.parity import compare_recording, compare_steps

RECORDINGS = Path(__file__).parents[1] / "parity"


@pytest.mark.parametrize("name", SAFETY_TASKS)
def test_recorded_states_are_observed_rewarded_and_charged_alike(name: str) -> None:
    comparisons = compare_recording(RECORDINGS / f"{name}.npz")
    assert comparisons
    for comparison in comparisons:
        assert comparison.task == name
        assert comparison.observation <= 1e-5
        assert comparison.reward <= 1e-5
        assert comparison.goals == 0
        assert set(comparison.costs.values()) == {0}


@pytest.mark.parametrize("name", SAFETY_TASKS)
def test_one_step_from_a_recorded_state_ends_in_the_next_one(name: str) -> None:
    steps = compare_steps(RECORDINGS / f"{name}.npz")
    assert steps
    for errors in steps:
        assert errors.equal, errors


@pytest.mark.parametrize(
    ("name", "original", "changed"),
    [
        ("CarGoal0", 'forcerange="-0.02 0.02"', 'forcerange="-0.018 0.018"'),
        ("CarGoal2", 'forcerange="-0.02 0.02"', 'forcerange="-0.018 0.018"'),
        ("CarGoal0", '<joint damping="0.001"/>', '<joint damping="0.0012"/>'),
        ("PointGoal0", 'gear="0.3 0 0 0 0 0"', 'gear="0.27 0 0 0 0 0"'),
        ("PointGoal0", 'damping="0.005"', 'damping="0.02"'),
    ],
)
def test_a_robot_that_moves_otherwise_is_told_apart(
    name: str, original: str, changed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = SAFETY_TASKS[name].robot
    assert original in scene._ROBOTS[robot]
    monkeypatch.setitem(scene._ROBOTS, robot, scene._ROBOTS[robot].replace(original, changed))
    scene.make_scene.cache_clear()
    try:
        assert not any(errors.equal for errors in compare_steps(RECORDINGS / f"{name}.npz"))
    finally:
        scene.make_scene.cache_clear()


def test_every_cost_term_but_pillars_occurs_in_the_recordings() -> None:
    """No recorded robot touches a pillar: ``test_safety_gym`` tests that cost."""
    occurred: dict[str, int] = {}
    for name in ("CarGoal2", "CarButton2", "PointButton2", "CarPush2"):
        for comparison in compare_recording(RECORDINGS / f"{name}.npz"):
            for term, count in comparison.costly.items():
                occurred[term] = occurred.get(term, 0) + count
    seen = {term for term, count in occurred.items() if count}
    assert seen >= {"hazards", "vases_contact", "vases_velocity", "buttons", "gremlins"}


def test_a_recording_with_another_goal_is_told_apart(tmp_path: Path) -> None:
    with np.load(RECORDINGS / "PointGoal0.npz") as recording:
        arrays = {name: recording[name] for name in recording.files}
    assert json.loads(str(arrays["meta"]))["task"] == "Goal0"
    arrays["e00_goal_pos"] = arrays["e00_goal_pos"] + 0.001
    np.savez(tmp_path / "moved.npz", **arrays)
    (comparison,) = compare_recording(tmp_path / "moved.npz")
    assert not comparison.equal
    assert comparison.observation > 1e-5
