"""Saved states: damaged ones, and those of other tasks, are refused in one sentence and change nothing."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recrl.environments.registry import make_vector
from recrl.environments.saved_state import IDENTITY
from recrl.environments.vector import CMDPVectorEnv

TASKS = ["CarGoal2", "CarButton2", "CarPush0", "SafetyHumanoidVelocity", "continuous-bandit"]
HUGE = 10**9


def started(name: str, num_envs: int = 2, **options: Any) -> CMDPVectorEnv:
    environments = make_vector(name, num_envs, options=options)
    environments.reset(seed=0)
    return environments


def refusal(environments: CMDPVectorEnv, state: dict[str, Any]) -> str:
    """Return the sentence with which a state is refused; nothing is changed."""
    before = environments.state_dict()
    with pytest.raises(ValueError) as error:
        environments.load_state_dict(state)
    np.testing.assert_equal(environments.state_dict(), before)
    return str(error.value)


def found(state: dict[str, Any], path: str) -> tuple[dict[str, Any], str]:
    """Return the dict in which the last name of a path is, and that name."""
    *parts, name = path.split(".")
    for part in parts:
        state = state[part]
    return state, name


def changed(state: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """Return a copy of a state with another value at a path; arrays are filled with it."""
    state = copy.deepcopy(state)
    place, name = found(state, path)
    if isinstance(place[name], np.ndarray) and np.isscalar(value):
        place[name][...] = value
    else:
        place[name] = value
    return state


def arrays(state: dict[str, Any], prefix: str = "") -> list[str]:
    """Return the paths of all arrays in a state."""
    paths = []
    for name, value in state.items():
        if isinstance(value, dict):
            paths += arrays(value, f"{prefix}{name}.")
        elif isinstance(value, np.ndarray):
            paths.append(prefix + name)
    return paths


@pytest.mark.parametrize("name", TASKS)
def test_every_array_of_a_state_is_checked(name: str) -> None:
    environments = started(name)
    state = environments.state_dict()
    assert arrays(state)
    for path in arrays(state):
        place, last = found(state, path)
        good = place[last]
        for bad in (good[..., None], good.astype(np.complex128), good.tolist()):
            text = refusal(environments, changed(state, path, bad))
            assert text.startswith(f"{name}: saved state: {path} must be {good.dtype} of shape "), text
        for bad in (good[:1], None):  # one environment would be copied to all
            assert refusal(environments, changed(state, path, bad)).startswith(
                f"{name}: saved state: {path} must be "
            )
        if good.dtype.kind == "f":
            for number in (np.nan, np.inf):
                text = refusal(environments, changed(state, path, number))
                assert text == f"{name}: saved state: {path} must have numbers that are finite, got {number}"
        missing = copy.deepcopy(state)
        del found(missing, path)[0][last]
        assert refusal(environments, missing) == f"{name}: saved state: {path} is missing"


@pytest.mark.parametrize(
    ("name", "path", "value", "bounds"),
    [
        ("CarButton2", "environments.goal_button", HUGE, "from 0 to 3"),
        ("CarButton2", "environments.goal_button", 4, "from 0 to 3"),
        ("CarButton2", "environments.goal_button", -1, "from 0 to 3"),
        ("CarButton2", "environments.button_timer", 11, "from 0 to 10"),
        ("CarButton2", "environments.embodied", HUGE, "from -2 to 5"),
        ("CarButton2", "environments.embodied", 6, "from -2 to 5"),
        ("CarButton2", "environments.embodied", -3, "from -2 to 5"),
        ("CarButton2", "environments.touching", 2, "from 0 to 1"),
        ("CarGoal2", "environments.embodied", 0, "from -2 to -1"),
        ("CarGoal2", "environments.goal_button", 1, "from 0 to 0"),
        ("CarGoal2", "environments.steps", -1, "from 0 to 2147483648"),
        ("CarGoal2", "physics.asleep", 10**6, "from -11 to 10"),
        ("CarGoal2", "physics.asleep", -12, "from -11 to 10"),
        ("CarGoal2", "physics.warnings", -1, "from 0 to inf"),
        ("SafetyHumanoidVelocity", "steps", 2**62, "from 0 to 2147483648"),
        ("continuous-bandit", "elapsed", 10, "from 0 to 9"),
    ],
)
def test_indices_and_counters_out_of_bounds_are_refused(
    name: str, path: str, value: int, bounds: str
) -> None:
    environments = started(name)
    text = refusal(environments, changed(environments.state_dict(), path, value))
    assert text == f"{name}: saved state: {path} must have numbers that are {bounds}, got {value}"


@pytest.mark.parametrize("sleepers", [{1: 2}, {1: 2, 2: 2}, {1: 2, 2: 3, 3: 2}])
def test_bodies_that_sleep_must_form_cycles(sleepers: dict[int, int]) -> None:
    environments = started("CarGoal2")
    row = np.full(11, -11)
    row[list(sleepers)] = list(sleepers.values())
    state = environments.state_dict()
    state["physics"]["asleep"][1] = row
    assert refusal(environments, state) == (
        f"CarGoal2: saved state: physics.asleep.1 must have cycles of sleeping bodies, got {row.tolist()}"
    )


def test_physics_that_mujoco_cannot_compute_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its errors to a file where it runs
    environments = started("CarGoal2")
    state = changed(environments.state_dict(), "physics.rows", 1e12)
    with pytest.raises(ValueError, match=r"^CarGoal2: saved state: physics\.rows\.0 cannot be computed by"):
        environments.load_state_dict(state)


@pytest.mark.parametrize(
    ("generators", "problem"),
    [
        (None, "generators must be a list or an array, got NoneType"),
        ("ab", "generators must be a list or an array, got str"),
        ([{}], "generators must be of 2 environments, got 1"),
        ([{}, {}], "generators.0 must be the state of a PCG64 (state must be for a PCG64 RNG)"),
        ([None, {}], "generators.0 must be the state of a PCG64 (state must be a dict)"),
    ],
)
def test_generators_that_are_none_are_refused(generators: Any, problem: str) -> None:
    environments = started("CarGoal0")
    state = {**environments.state_dict(), "generators": generators}
    assert refusal(environments, state) == f"CarGoal0: saved state: {problem}"


def test_a_state_that_is_no_dict_is_refused() -> None:
    environments = started("SafetyAntVelocity")
    broken: Any = [1, 2]
    assert refusal(environments, broken) == "SafetyAntVelocity: saved state: it must be a dict, got list"
    state = {**environments.state_dict(), "physics": 3}
    assert refusal(environments, state) == "SafetyAntVelocity: saved state: physics must be a dict, got int"


def test_a_state_of_another_task_is_refused() -> None:
    """The two robots have the same sizes."""
    walker = started("SafetyWalker2dVelocity")
    assert refusal(walker, started("SafetyHalfCheetahVelocity").state_dict()) == (
        "SafetyWalker2dVelocity: saved state: identity.task must be 'SafetyWalker2dVelocity', "
        "got 'SafetyHalfCheetahVelocity'"
    )


def test_a_state_of_another_horizon_or_other_costs_is_refused() -> None:
    for name in ("CarGoal2", "SafetyAntVelocity", "continuous-bandit"):
        short, long = started(name, horizon=50), started(name, horizon=60)
        assert refusal(long, short.state_dict()) == (
            f"{name}: saved state: identity.horizon must be 60, got 50"
        )
    single, several = started("CarGoal2"), started("CarGoal2", cost="per_hazard")
    assert refusal(single, several.state_dict()) == (
        "CarGoal2: saved state: identity.num_costs must be 1, got 3"
    )


@pytest.mark.parametrize("name", TASKS)
def test_a_state_of_an_older_version_has_no_identity_and_is_loaded(name: str) -> None:
    environments, other = started(name), make_vector(name, 2)
    state = environments.state_dict()
    del state[IDENTITY]
    other.load_state_dict(state)
    np.testing.assert_equal(other.state_dict(), environments.state_dict())


def test_a_loaded_state_stays_as_it_was() -> None:
    for name in TASKS:
        environments = started(name)
        state = environments.state_dict()
        kept = copy.deepcopy(state)
        environments.load_state_dict(state)
        for _ in range(3):
            environments.step(environments.action_space.sample())
        np.testing.assert_equal(state, kept)
